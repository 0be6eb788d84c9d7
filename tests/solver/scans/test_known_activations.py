"""Tables of known activations: how muscles are named, what is known when, and bad input."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.scans.known_activations import KnownTable, KnownTableOptions, read_known

MUSCLES = ("procerus", "frontalis_l.medial", "frontalis_l.lateral", "frontalis_r", "masseter_r")


def write(folder: Path, text: str) -> Path:
    path = folder / "emg.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_muscles_are_wholes_or_compartments_on_a_side_that_the_name_or_a_column_tells(
    tmp_path: Path,
) -> None:
    rows = (
        "muscle,side,expression,value,sd",
        "Frontalis,left,frown,0.1,0.05",
        "frontalis_r,,frown,-0.2,0.1",
        "frontalis_l.medial,L,raise,0.3,0.1",
        "procerus,,raise,1,0.2",
        "frontalis.lateral,left,raise,0.4,0.1",
    )
    known = read_known(write(tmp_path, "\n".join(rows)), MUSCLES).of_expressions(
        ["raise", "frown", "smile"]
    )
    assert known["frown"].names == ("frontalis_l", "frontalis_r")
    np.testing.assert_allclose(known["frown"].values, [0.1, -0.2])
    np.testing.assert_allclose(known["frown"].sd, [0.05, 0.1])
    assert known["raise"].names == ("frontalis_l.medial", "procerus", "frontalis_l.lateral")
    assert "smile" not in known


def test_a_single_scan_needs_no_name(tmp_path: Path) -> None:
    table = read_known(write(tmp_path, "muscle,value,sd\nprocerus,0.2,0.1\n"), MUSCLES)
    assert table.of_expressions(["frown"])["frown"].names == ("procerus",)


def test_between_times_values_are_interpolated_and_beyond_a_channel_nothing_is_known(
    tmp_path: Path,
) -> None:
    rows = ("0.5,procerus,0.3,0.1", "0.1,procerus,0.1,0.2", "0.4,masseter_r,0.5,0.1")
    path = write(tmp_path, "\n".join(("time,muscle,value,sd", *rows)))
    course = read_known(path, MUSCLES).of_take(frames=10, rate=10.0)
    between = course.at(0.2)
    assert between.names == ("procerus",)
    assert between.values[0] == pytest.approx(0.15)
    assert between.sd[0] == pytest.approx(0.175)
    assert course.at(0.4).names == ("procerus", "masseter_r")
    # a channel holds for half a frame beside its times, so that one time is a frame's
    assert course.at(0.36).names == ("procerus", "masseter_r")
    assert course.at(0.54).values[0] == pytest.approx(0.3)
    assert len(course.at(0.56)) == len(course.at(0.0)) == 0


def use(table: KnownTable) -> None:
    if table.times is None:
        table.of_expressions(["smile", "frown"])
    else:
        table.of_take(frames=10, rate=10.0)


BY_TIME = "muscle,time,value,sd\n"
BY_NAME = "muscle,expression,value,sd\n"


@pytest.mark.parametrize(
    ("code", "text", "words"),
    [
        ("muscle", BY_NAME + "frontalys_l,smile,0.1,0.1", "line 2: no muscle.* frontalis_l"),
        ("muscle", BY_NAME + ",smile,0.1,0.1", "no muscle"),
        ("muscle", BY_NAME + "frontalis,smile,0.1,0.1", "say left or right"),
        ("muscle", "muscle,side,value,sd\nprocerus,left,0.1,0.1", "has no side"),
        ("muscle", "muscle,side,value,sd\nfrontalis_l,right,0.1,0.1", "is on the left"),
        ("muscle", "muscle,side,value,sd\nfrontalis,up,0.1,0.1", "neither left nor right"),
        ("value", BY_NAME + "procerus,smile,1.2,0.1", "line 2: procerus: the value 1.2"),
        ("value", BY_NAME + "procerus,smile,-3,0.1", "-1 to 1"),
        ("value", BY_NAME + "procerus,smile,much,0.1", "procerus: the value much is no number"),
        ("value", BY_NAME + "procerus,smile,nan,0.1", "no number"),
        ("sd", BY_NAME + "procerus,smile,0.1,0", "not above 0"),
        ("sd", BY_NAME + "procerus,smile,0.1,inf", "no number"),
        ("time", BY_TIME + "procerus,soon,0.1,0.1", "no number"),
        ("time", BY_TIME + "procerus,0,0.1,0.1\nprocerus,9,0.1,0.1", "line 3: .*lasts 1 s"),
        ("time", BY_TIME + "procerus,-0.1,0.1,0.1", "outside the take"),
        ("expression", BY_NAME + "procerus,grin,0.1,0.1", "grin: it has smile, frown"),
        ("expression", BY_NAME + "procerus,,0.1,0.1", "has several"),
        ("duplicate", BY_TIME + 2 * "procerus,0.5,0.1,0.1\n", "line 3: .*twice at 0.5 s: line 2"),
        ("duplicate", BY_NAME + 2 * "procerus,smile,0.1,0.1\n", "line 3: .*twice in smile"),
        ("columns", "muscle,value,sd,hue\nprocerus,0.1,0.1,7", "hue is not known"),
        ("columns", "muscle,value\nprocerus,0.1", "sd is missing"),
        ("columns", "muscle,value,sd,sd\nprocerus,0.1,0.1,0.1", "twice"),
        ("columns", "muscle,time,expression,value,sd\nprocerus,0,x,0,1", "exclude each other"),
        ("columns", "", "line 1: the column muscle is missing"),
        ("unreadable", BY_TIME, "no rows"),
        ("unreadable", BY_TIME + "procerus,0,0.1", "line 2: 4 columns expected, 3 found"),
        ("unreadable", BY_TIME + f"{'m' * 300},0,0.1,0.1", "characters"),
        ("unreadable", BY_TIME + "," * 20_000, "line 2: the line has more than 10,000"),
        ("unreadable", BY_TIME + '"' + 200_000 * "m\n", "no table"),
    ],
)
def test_what_cannot_be_used_is_told_with_its_line(
    code: str, text: str, words: str, tmp_path: Path
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=words) as told:
        use(read_known(path, MUSCLES))
    assert told.value.code == f"activations.{code}"
    assert told.value.context["file"] == "emg.csv"
    assert told.value.context["line"] >= 1


def test_a_table_of_times_is_of_takes_and_one_of_names_of_scans(tmp_path: Path) -> None:
    by_time = read_known(write(tmp_path, BY_TIME + "procerus,0.5,0.1,0.1"), MUSCLES)
    by_name = read_known(write(tmp_path, BY_NAME + "procerus,smile,0.1,0.1"), MUSCLES)
    with pytest.raises(InputError, match="it has times") as told:
        by_time.of_expressions(["smile"])
    assert told.value.code == "activations.columns"
    with pytest.raises(InputError, match="no column time"):
        by_name.of_take(10, 10.0)


def test_text_that_is_none_and_tables_that_are_too_large(tmp_path: Path) -> None:
    path = tmp_path / "emg.csv"
    path.write_bytes(b"\xff\xfe\x00m")
    with pytest.raises(InputError, match="UTF-8") as told:
        read_known(path, MUSCLES)
    assert told.value.code == "activations.unreadable"
    path.write_text(BY_TIME + 4 * "procerus,0.5,0.1,0.1\n")
    for options in (KnownTableOptions(most_rows=3), KnownTableOptions(most_bytes=50)):
        with pytest.raises(InputError, match=r"more than 3 rows|bytes") as told:
            read_known(path, MUSCLES, options)
        assert told.value.code == "activations.unreadable"


def test_an_hour_of_channels_is_read_in_seconds(tmp_path: Path) -> None:
    """The work grows with the rows alone, whatever they say."""
    rows = "".join(f"frontalis_r,{0.01 * n:.2f},0.1,0.1\n" for n in range(100_000))
    start = time.process_time()
    course = read_known(write(tmp_path, BY_TIME + rows), MUSCLES).of_take(100_000, 100.0)
    for number in range(1000):
        assert len(course.at(0.01 * number)) == 1
    assert time.process_time() - start < 5.0
