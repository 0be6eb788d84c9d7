"""Recordings of Live Link Face: what is read, and how a broken one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.scans.live_link import ARKIT_NAMES, read_live_link
from tests.fixtures import data_folder

HEADER = ["Timecode", "BlendShapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES)]


TURNS = [
    f"{bone}{angle}"
    for bone in ("Head", "LeftEye", "RightEye")
    for angle in ("Yaw", "Pitch", "Roll")
]


def write(
    path: Path,
    times: list[str],
    header: list[str] = HEADER,
    weight: str = "0.5",
    turns: tuple[str, ...] = (),
) -> Path:
    rows = [[time, "52", *[weight] * (len(header) - 2), *turns] for time in times]
    header = [*header, *TURNS[: len(turns)]]
    path.write_text("\r\n".join(",".join(row) for row in [header, *rows]) + "\r\n")
    return path


def test_a_real_recording() -> None:
    take = read_live_link(data_folder("performance", "alex_rom_3.csv"))
    assert take.weights.shape == (4030, 52)
    assert np.median(np.diff(take.times)) == pytest.approx(1 / 30, abs=1e-4)
    assert take.weights[0, ARKIT_NAMES.index("eyeBlinkLeft")] == 0.1236470118
    assert take.weights[0, ARKIT_NAMES.index("jawOpen")] == 0.0190581698
    assert not take.head.any()
    assert take.timecodes[0] == "13:13:04:31.652"


@pytest.mark.parametrize(
    ("ticks", "fps", "found"),
    [
        (60, 60, 60),
        (60, 30, 60),
        (60, 2, 60),
        (24, 24, 24),
        (25, 25, 25),
        (30, 30, 30),
        (30, 15, 30),
    ],
)
def test_ticks_of_a_second_are_those_that_make_steps_even(
    ticks: int, fps: int, found: int, tmp_path: Path
) -> None:
    frames = [divmod(number * ticks // fps, ticks) for number in range(4 * fps)]
    codes = [f"10:00:{second:02}:{tick:02}.500" for second, tick in frames]
    take = read_live_link(write(tmp_path / "a.csv", codes))
    np.testing.assert_allclose(np.diff(take.times), 1.0 / fps, atol=1e-9)
    told = [each.context["found"] for each in take.notices]
    assert told == ([] if found == 60 else [found])


def test_a_gap_in_a_recording_changes_no_ticks(tmp_path: Path) -> None:
    frames = [divmod(2 * number, 60) for number in range(150) if not 40 < number < 100]
    codes = [f"10:00:{second:02}:{tick:02}.0" for second, tick in frames]
    take = read_live_link(write(tmp_path / "a.csv", codes))
    assert not take.notices
    assert np.median(np.diff(take.times)) == pytest.approx(1 / 30)


def test_eyes_look_where_the_weights_say() -> None:
    """A gaze to the left has x > 0, to the right eye that is inward; one upward has y > 0."""
    take = read_live_link(data_folder("performance", "alex_rom_3.csv"))
    weight = {name: take.weights[:, number] for number, name in enumerate(ARKIT_NAMES)}
    for eye, (side, left, right) in enumerate((("Left", "Out", "In"), ("Right", "In", "Out"))):
        gaze = Rotation.from_rotvec(take.eyes[:, eye]).apply([0.0, 0.0, 1.0])
        sideways = weight[f"eyeLook{left}{side}"] - weight[f"eyeLook{right}{side}"]
        upward = weight[f"eyeLookUp{side}"] - weight[f"eyeLookDown{side}"]
        assert np.corrcoef(gaze[:, 0], sideways)[0, 1] > 0.95
        assert np.corrcoef(gaze[:, 1], upward)[0, 1] > 0.95
        # a turn about the eye's height and then its upright axis, if order and signs are right
        torsion = Rotation.from_rotvec(take.eyes[:, eye]).as_euler("XYZ")[:, 2]
        assert np.abs(torsion).max() < 1e-6


def test_the_head_turns_as_its_angles_say(tmp_path: Path) -> None:
    """Half a radian to the subject's right; downward; what that is as one turn."""
    for turns, looks in (
        (("0.5", "0", "0"), (-np.sin(0.5), 0.0, np.cos(0.5))),
        (("0", "0.5", "0"), (0.0, -np.sin(0.5), np.cos(0.5))),
    ):
        take = read_live_link(write(tmp_path / "take.csv", ["1:0:0:0"], turns=turns))
        gaze = Rotation.from_rotvec(take.head[0]).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(gaze, looks, atol=1e-12)
        assert not take.eyes.any()


def test_degrees_are_no_radians(tmp_path: Path) -> None:
    path = write(tmp_path / "take.csv", ["1:0:0:0"], turns=("30", "0", "0"))
    with pytest.raises(InputError, match="headYaw is 30") as caught:
        read_live_link(path)
    assert caught.value.code == "live_link.value"


def test_time_goes_on_after_midnight(tmp_path: Path) -> None:
    take = read_live_link(write(tmp_path / "take.csv", ["23:59:59:58.0", "00:00:00:01.0"]))
    np.testing.assert_allclose(take.times, [0.0, 3 / 60])


@pytest.mark.parametrize(
    ("times", "header", "weight", "code", "line"),
    [
        (["1:0:0:0"], [name for name in HEADER if name != "JawOpen"], "0", "columns", 1),
        (["1:0:0:0", "1:0:0:2", "1:0:0:1"], HEADER, "0", "time_order", 4),
        (["23:59:59:58", "0:0:0:1", "0:0:0:1"], HEADER, "0", "time_order", 4),
        (["1:0:0:0", "later"], HEADER, "0", "timecode", 3),
        (["1:0:0:0"], HEADER, "nan", "value", 2),
        (["1:0:0:0"], HEADER, "50", "value", 2),
        (["1:0:0:0"], HEADER, "", "value", 2),
        ([], HEADER, "0", "unreadable", None),
    ],
)
def test_a_broken_recording_names_the_line(
    times: list[str], header: list[str], weight: str, code: str, line: int | None, tmp_path: Path
) -> None:
    path = write(tmp_path / "take.csv", times, header, weight)
    with pytest.raises(InputError) as caught:
        read_live_link(path)
    assert caught.value.code == f"live_link.{code}"
    assert caught.value.context.get("line") == line
    assert "take.csv" in caught.value.message
