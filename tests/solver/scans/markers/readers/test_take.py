"""Takes: what every format gives, what is settled and told, and how a broken file is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import Finding, InputError
from solver.scans.markers.readers.raw_take import TakeEvent, TakeOptions, make_finding
from solver.scans.markers.readers.table import Table
from solver.scans.markers.readers.take import Take, read_take
from tests.fixtures import data_folder
from tests.take_files import (
    DEC,
    INTEL,
    MIPS,
    c3d_bytes,
    default_labels,
    face_points,
    motive_bytes,
    npz_bytes,
    trc_bytes,
)


def read(tmp_path: Path, content: bytes, name: str = "take.dat", **options: int) -> Take:
    path = tmp_path / name
    path.write_bytes(content)
    return read_take(path, TakeOptions(**options))


def codes(take: Take) -> list[tuple[str, str]]:
    return [(finding.code.removeprefix("markers."), finding.severity) for finding in take.findings]


@pytest.mark.parametrize("name", ["jaw", "nose"])
def test_real_takes_say_the_same_in_both_formats(name: str) -> None:
    folder = data_folder("markers", "animface")
    c3d, trc = (read_take(folder / f"{name}.{suffix}") for suffix in ("c3d", "trc"))
    assert c3d.positions.shape == ({"jaw": 1590, "nose": 962}[name], 40, 3)
    assert (c3d.rate, c3d.first, c3d.unit_mm) == (60.0, 1, 1.0)
    assert c3d.labels == trc.labels
    assert c3d.labels[0] == "ForeHead_M"
    assert np.abs(c3d.positions - trc.positions).max() < 1e-4
    assert not c3d.findings
    assert not trc.findings


@pytest.mark.parametrize("scale", [-1.0, 0.05])
@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
def test_c3d_of_all_processors(tmp_path: Path, processor: int, scale: float) -> None:
    points = face_points()
    times = np.array([[0.0, 0.5], [1.0, 2.25]], np.float32)
    more = {
        ("EVENT", "LABELS"): ["start", "clap"],
        ("EVENT", "TIMES"): times,
        ("POINT", "Y_SCREEN"): ["+Z"],
        ("TRIAL", "ACTUAL_START_FIELD"): np.array([464, 1], np.int16),
        ("TRIAL", "ACTUAL_END_FIELD"): np.array([475, 1], np.int16),
    }
    content = c3d_bytes(
        points, processor=processor, scale=scale, rate=59.94, analog=(3, 4), parameters=more
    )
    take = read(tmp_path, content)
    np.testing.assert_allclose(take.positions, points, atol=max(scale, 0.0) / 2)
    np.testing.assert_array_equal(take.missing, np.isnan(points[..., 0]))
    np.testing.assert_allclose(take.residual[~take.missing], 2 * abs(scale), rtol=1e-6)
    assert take.labels == tuple(default_labels(5))
    assert take.rate == pytest.approx(59.94)
    assert take.first == 66000
    assert take.up == "z"
    assert [(event.name, event.time) for event in take.events] == [("start", 0.5), ("clap", 62.25)]
    assert not take.findings


def test_c3d_without_parameters_for_frames_beyond_16_bits(tmp_path: Path) -> None:
    points = face_points(70_000, 3)
    said = {
        "trial": {
            ("TRIAL", "ACTUAL_START_FIELD"): np.array([1, 0], np.int16),
            ("TRIAL", "ACTUAL_END_FIELD"): np.array([70_000 - 65_536, 1], np.int16),
        },
        "long": {("POINT", "LONG_FRAMES"): np.float32(70_000)},
        "float": {("POINT", "FRAMES"): np.float32(70_000)},
        "full": {},
        "overflown": {("POINT", "FRAMES"): np.int16(70_000 - 65_536)},
    }
    for name, parameters in said.items():
        take = read(tmp_path, c3d_bytes(points, parameters=parameters))
        rest = take.positions[70_000:]  # of the last block, where no place says the number
        assert len(rest) == (5 if name == "full" else 0), name
        assert np.isnan(rest).all()
        np.testing.assert_array_equal(take.positions[:70_000], points)
        assert codes(take) == ([("header", "warning")] if name in ("full", "overflown") else [])


def test_c3d_with_300_labels(tmp_path: Path) -> None:
    take = read(tmp_path, c3d_bytes(face_points(3, 300)))
    assert take.labels == tuple(default_labels(300))


@pytest.mark.parametrize("newer", [False, True])
def test_motive_reads_markers_and_not_where_a_solver_has_them(tmp_path: Path, newer: bool) -> None:
    points = face_points()
    take = read(tmp_path, motive_bytes(points, newer=newer, first=40))
    assert take.labels == (*default_labels(5), "Marker1")
    np.testing.assert_allclose(take.positions[:, :5], points, atol=1e-6)
    np.testing.assert_array_equal(take.positions[:, 5], [[9, 8, 7]] * 12)
    assert (take.first, take.rate, take.subject) == (40, 120.0, "Head")
    assert not take.findings


def test_trc_with_blanks_zeros_and_frames_left_out(tmp_path: Path) -> None:
    points = face_points()
    points[3, 2] = 0.0
    lines = trc_bytes(points, rate=59.94, first=7).splitlines(keepends=True)
    take = read(tmp_path, b"".join(lines[:10] + lines[12:]))
    points[3, 2] = np.nan
    points[4:6] = np.nan
    np.testing.assert_allclose(take.positions, points, atol=1e-6)
    assert (take.first, take.rate) == (7, 59.94)
    assert codes(take) == [("frames", "warning")]


def test_drop_frame_numbers_are_no_gaps(tmp_path: Path) -> None:
    points = face_points(40)
    content = trc_bytes(points, rate=29.97, first=1780)
    rows = content.decode().split("\r\n")
    for number, row in enumerate(rows[6:-1]):
        frame, rest = row.split("\t", 1)
        rows[6 + number] = f"{int(frame) + 2 * (int(frame) >= 1800)}\t{rest}"
    (tmp_path / "a.trc").write_bytes("\r\n".join(rows).encode())
    take = read_take(tmp_path / "a.trc")
    assert len(take) == 40
    assert take.first == 1780
    np.testing.assert_allclose(take.positions, points, atol=1e-4)
    (found,) = take.findings
    assert "drop-frame" in found.message
    assert take.rate == pytest.approx(29.97)


def test_trc_with_blanks_for_tabs(tmp_path: Path) -> None:
    points = np.abs(face_points(4)[[0, 1]])
    content = trc_bytes(points).replace(b"\t", b" ").replace(b"\r\n\r\n", b"\n")
    np.testing.assert_allclose(read(tmp_path, content).positions, points, atol=1e-6)


def test_npz_of_landmarks_has_sigma_by_axis(tmp_path: Path) -> None:
    points = face_points() / 1000
    sigma = np.array([0.001, 0.001, np.inf])
    depth = np.broadcast_to([0.001, 0.001, 0.004], points.shape).copy()
    depth[2, 1] = sigma
    take = read(tmp_path, npz_bytes(points, sigma=depth, rate=30.0, unit="m", first=5))
    np.testing.assert_allclose(take.sigma[0], [[1.0, 1.0, 4.0]] * 5)
    assert take.missing.sum() == 2
    assert take.missing[2, 1]
    assert (take.rate, take.first, take.unit_mm) == (30.0, 5, 1000.0)
    take.save(tmp_path / "kept.npz")
    kept = read_take(tmp_path / "kept.npz")
    assert kept.labels == take.labels
    np.testing.assert_array_equal(kept.positions, take.positions)
    np.testing.assert_array_equal(kept.sigma, take.sigma)
    with pytest.raises(InputError, match="sigma of LBRO1 in frame 0"):
        read(tmp_path, npz_bytes(points, sigma=np.zeros((5, 3))))
    with pytest.raises(InputError, match="sigma of LBRO1 in frame 0"):
        read(tmp_path, npz_bytes(points, sigma=np.full((5, 3), 1e-320)))
    with pytest.raises(InputError, match="'unit' is 1e-300"):
        read(tmp_path, npz_bytes(points, unit=1e-300))
    slow = read(tmp_path, npz_bytes(points, rate=1e-300, unit="mm"))
    assert np.isnan(slow.rate)
    assert ("rate", "warning") in codes(slow)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": float("inf")}, "rate"),
        ({"rate": -1.0}, "rate"),
        ({"rate": 1e-300}, "rate"),
        ({"unit_mm": 0.0}, "unit"),
        ({"unit_mm": float("nan")}, "unit"),
        ({"first": 10**30}, "frame"),
        ({"positions": np.full((5, 4, 3), 1e30)}, "studio"),
        ({"labels": ("a", "b", "c", "a")}, "'a' twice"),
        ({"labels": ("a", "b", "c", "x" * 5000)}, "no label"),
        ({"labels": ("a", "b", "c", "\x1b[31m")}, "no label"),
        ({"events": (TakeEvent("start", float("nan")),)}, "event"),
        ({"sigma": np.full((5, 4, 3), 1e-320)}, "sigma"),
        ({"sigma": np.full((5, 4, 3), np.inf)}, "sigma"),
    ],
)
def test_a_kept_take_is_bounded_as_others_are(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    whole = Take("a.c3d", ("a", "b", "c", "d"), face_points(5, 4), 60.0)
    path = tmp_path / "kept.npz"
    replace(whole, **change).save(path)
    with pytest.raises(InputError, match=words) as caught:
        read_take(path)
    assert caught.value.code == "markers.unreadable"


def test_of_a_kept_take_only_known_findings_are_told(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    points = face_points(5, 4)
    points[1, 2, 1] = np.nan
    known = make_finding("markers.rate", "warning", "no rate", file="a.c3d")
    forged = (
        Finding("markers.forged", "error", "call this number"),
        replace(known, advice="call this number"),
        replace(known, severity="fatal"),
        replace(known, message="x" * 10_000),
        replace(known, context={"found": float("nan")}),
    )
    take = Take("a.c3d", ("a", "b", "c", "d"), points, 60.0, up="upwards")
    replace(take, findings=(known, *forged)).save(path)
    kept = read_take(path)
    assert kept.findings == (known, known)
    assert kept.up is None
    assert np.isnan(kept.positions[1, 2]).all()  # a point of which a part is missing is none
    replace(take, positions=np.full((5, 4, 3), np.nan)).save(path)
    with pytest.raises(InputError) as caught:
        read_take(path)
    assert caught.value.code == "markers.none"
    names = tuple(f"#{number}" for number in range(10_001))
    more = replace(take, unlabelled=np.zeros((5, 10_001, 3)), unlabelled_names=names)
    more.save(path)
    with pytest.raises(InputError) as caught:
        read_take(path)
    assert caught.value.code == "markers.too_large"


def test_labels_lose_blanks_and_subject_and_those_without_are_kept_apart(tmp_path: Path) -> None:
    names = [
        "Jane: LBRO1 ",
        "Jane:RBRO1",
        "*12",
        "U_3",
        "Unlabeled 1004",
        "Unlabeled_7",
        "Ulip",
        "",
    ]
    points = face_points(4, len(names))
    take = read(tmp_path, c3d_bytes(points, names))
    assert take.labels == ("LBRO1", "RBRO1", "Ulip")
    assert take.subject == "Jane"
    assert take.unlabelled_names == ("*12", "U_3", "Unlabeled 1004", "Unlabeled_7", "#8")
    np.testing.assert_array_equal(take.unlabelled, points[:, [2, 3, 4, 5, 7]])
    assert codes(take) == [("labels", "warning")]


def test_labels_alike_or_foreign_have_proposals(tmp_path: Path) -> None:
    names = ["LIP", "LIP", "LIP_2", "LIP", "Bräu"]
    take = read(tmp_path, trc_bytes(face_points(), names))
    assert take.labels == ("LIP", "LIP_3", "LIP_2", "LIP_4", "Bräu")
    assert codes(take) == [("labels", "warning"), ("labels", "info")]
    twice, foreign = take.findings
    assert twice.context["proposals"] == {"LIP_3": "LIP", "LIP_4": "LIP"}
    assert foreign.context["proposals"] == {"Bräu": "Brau"}


def test_long_labels_alike_stay_short_enough_for_a_marker_set(tmp_path: Path) -> None:
    take = read(tmp_path, trc_bytes(face_points(4, 30), ["L" * 300] * 30))
    assert len(set(take.labels)) == 30
    assert max(map(len, take.labels)) <= 100
    assert len(take.findings[0].context["proposals"]) == 20


def test_two_subjects_with_the_same_labels_are_two_faces(tmp_path: Path) -> None:
    take = read(tmp_path, c3d_bytes(face_points(4, 3), ["A:LIP", "B:LIP", "B:CHIN"]))
    assert take.labels == ("A:LIP", "B:LIP", "B:CHIN")
    assert codes(take) == [("two_faces", "warning")]


def test_a_take_of_unlabelled_tracks_only(tmp_path: Path) -> None:
    take = read(tmp_path, c3d_bytes(face_points(4, 3), ["*1", "*2", "*3"]))
    assert take.positions.shape == (4, 0, 3)
    assert take.unlabelled.shape == (4, 3, 3)
    assert codes(take) == [("labels", "warning")]
    take = read(tmp_path, c3d_bytes(face_points(4, 3), ["*", "*", "*"]))
    assert len(set(take.unlabelled_names)) == 3


@pytest.mark.parametrize(
    ("unit", "factor", "found", "told"),
    [
        ("m", 1e-3, 1000.0, []),
        ("cm", 0.1, 10.0, []),
        (None, 1.0, 1.0, [("unit", "info")]),
        (None, 1e-3, 1000.0, [("unit", "info")]),
        (None, 1 / 25.4, 25.4, [("unit", "warning")]),
        (None, 1 / 304.8, 304.8, [("unit", "warning")]),
        ("mm", 1e-3, 1000.0, [("unit", "warning")]),
        ("parsec", 0.1, 10.0, [("unit", "warning")]),
        ("mm", 1e-6, 1.0, [("unit", "error")]),
    ],
)
def test_units_by_the_file_or_by_the_face(
    tmp_path: Path, unit: str | None, factor: float, found: float, told: list[tuple[str, str]]
) -> None:
    points = face_points(6, 30)
    take = read(tmp_path, c3d_bytes(points * factor, unit=unit))
    assert take.unit_mm == found
    assert codes(take) == told
    if ("unit", "error") not in told:
        np.testing.assert_allclose(take.positions, points, rtol=1e-5)


def test_rates_that_are_missing_or_differ_are_told(tmp_path: Path) -> None:
    points = face_points()
    take = read(tmp_path, c3d_bytes(points, rate=0.0))
    assert np.isnan(take.rate)
    assert codes(take) == [("rate", "warning")]
    take = read(tmp_path, trc_bytes(points, rate=60.0, says={"DataRate": "0"}))
    assert take.rate == pytest.approx(60.0, rel=1e-4)
    assert codes(take) == [("rate", "warning")]
    take = read(tmp_path, trc_bytes(points, rate=1000.0, says={"DataRate": "60"}))
    assert take.rate == 60.0
    assert codes(take) == [("rate", "warning")]
    assert not read(tmp_path, trc_bytes(points, rate=1000.0)).findings


def test_times_that_jump_are_of_the_same_rate() -> None:
    points = np.zeros((50, 1, 3))
    for jump in (5.0, -0.3):
        times = np.arange(50) / 100.0 + jump * (np.arange(50) > 25)
        ((_, rate),) = Table([*range(50)], times.tolist(), points).timed_rate()
        assert rate == pytest.approx(100.0)


def test_points_out_of_the_world_count_as_missing(tmp_path: Path) -> None:
    points = face_points()
    points[3, 1] = 1e30
    points[4, 1] = np.inf
    take = read(tmp_path, npz_bytes(points))
    assert take.missing[[3, 4], 1].all()
    assert ("far", "warning") in codes(take)
    assert take.findings[-1].context["frame"] == 4  # by the file's numbers


POINTS = face_points()
WHOLE = c3d_bytes(POINTS)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "unreadable"),
        (b"\2Q" + bytes(1000), "unreadable"),
        (b"\2P", "truncated"),
        (WHOLE[:700], "truncated"),
        (b"\xf0" + WHOLE[1:], "truncated"),  # parameters beyond the file
        (WHOLE[:-512], "truncated"),
        (WHOLE[:515] + b"\x20" + WHOLE[516:], "unreadable"),  # no such processor
        (c3d_bytes(POINTS, parameters={("POINT", "LONG_FRAMES"): np.float32(2**31)},
                   header={"last": 65535}), "read"),
        (c3d_bytes(POINTS, parameters={("POINT", "FRAMES"): np.float32(2**31)},
                   header={"last": 65535}), "truncated"),
        (c3d_bytes(POINTS[:, :0], analog=(4, 10)), "none"),
        (c3d_bytes(POINTS[:0]), "none"),
        (c3d_bytes(np.full((5, 2, 3), np.nan)), "none"),
        (trc_bytes(POINTS)[:-200], "truncated"),
        (trc_bytes(POINTS, says={"NumFrames": "13"}), "truncated"),
        (trc_bytes(POINTS).replace(b"Frame#", b"Marker"), "unreadable"),
        (trc_bytes(POINTS[:0]), "none"),
        (trc_bytes(POINTS).replace(b"\r\n9\t", b"\r\n2\t"), "unreadable"),
        (trc_bytes(POINTS).replace(b"\r\n9\t", b"\r\n90000000\t"), "unreadable"),
        (trc_bytes(POINTS).replace(b"8.", b"8,"), "unreadable"),
        (motive_bytes(POINTS)[:-300], "truncated"),
        (motive_bytes(POINTS).replace(b"Frame,Time", b"Time,Frame"), "unreadable"),
        (motive_bytes(POINTS).replace(b"Position", b"Rotation"), "none"),
        ("PathFileType".encode("utf-16"), "unreadable"),
        (npz_bytes(POINTS)[:-40], "unreadable"),
        (npz_bytes(POINTS, ["a"]), "unreadable"),
        (npz_bytes(POINTS, sigma=np.ones((2, 2))), "unreadable"),
        (npz_bytes(POINTS[..., :2]), "unreadable"),
    ],
)  # fmt: skip
def test_broken_files_are_refused_in_plain_words(tmp_path: Path, content: bytes, code: str) -> None:
    if code == "read":  # one wrong field of two
        np.testing.assert_array_equal(read(tmp_path, content).positions, POINTS)
        return
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    assert caught.value.code == f"markers.{code}"
    assert caught.value.context["file"] == "take.dat"
    assert "take.dat" in caught.value.message


def test_nothing_is_loaded_before_it_is_bounded(tmp_path: Path) -> None:
    for content in (WHOLE, trc_bytes(POINTS), motive_bytes(POINTS), npz_bytes(POINTS)):
        with pytest.raises(InputError) as caught:
            read(tmp_path, content, most_values=100)
        assert caught.value.code == "markers.too_large"
    with pytest.raises(InputError) as caught:
        read(tmp_path, WHOLE, most_bytes=1000)
    assert caught.value.code == "markers.too_large"
    with pytest.raises(InputError, match="line 3: it has more than 40 bytes"):
        read(tmp_path, trc_bytes(POINTS).replace(b"DataRate\tC", b"D\t\r\n"), longest_line=40)


def _spoilt(content: bytes, count: int, span: tuple[int, int], seed: int) -> list[bytes]:
    """Return files of which bytes in ``span`` are changed, cut out, doubled, or the end is gone."""
    random = np.random.default_rng(seed)
    found = []
    for number in range(count):
        at = int(random.integers(*span))
        length = int(random.choice([1, 2, 4, 40]))
        noise = random.bytes(length)
        if number % 4 == 0:
            found.append(content[: int(random.integers(0, len(content) - 60))])
        elif number % 4 == 1:
            found.append(content[:at] + noise + content[at + length :])
        elif number % 4 == 2:
            found.append(content[:at] + content[at + length :])
        else:
            found.append(content[:at] + content[at : at + length] + content[at:])
    return found


@pytest.mark.parametrize("name", ["intel", "mips", "scaled", "dec", "trc", "motive", "npz"])
def test_100_broken_files_are_refused_or_read_right(tmp_path: Path, name: str) -> None:
    """What a file says of its data is spoilt; what the data are nobody can check."""
    points = face_points(40, 7)
    analog = (2, 3)
    whole = {
        "intel": c3d_bytes(points, analog=analog),
        "mips": c3d_bytes(points, processor=MIPS),
        "scaled": c3d_bytes(points, scale=0.05),
        "dec": c3d_bytes(points, processor=DEC),
        "trc": trc_bytes(points),
        "motive": motive_bytes(points),
        "npz": npz_bytes(points),
    }[name]
    right = read(tmp_path, whole).positions
    ends = {"trc": whole.find(b"\r\n1\t"), "motive": whole.find(b"\r\n0,"), "npz": len(whole)}
    span = (0, ends.get(name, 1024))
    refused = []
    wrong = []
    for number, content in enumerate(_spoilt(whole, 100, span, seed=3)):
        try:
            take = read(tmp_path, content)
        except InputError as error:
            refused.append(error.code)
            continue
        found = np.concatenate([take.positions, take.unlabelled], axis=1)
        is_right = found.shape == right.shape and np.allclose(
            np.sort(found, axis=1), np.sort(right, axis=1), atol=1e-3, equal_nan=True
        )
        if not is_right and not any(each.code == "markers.unit" for each in take.findings):
            wrong.append(number)
    assert not wrong
    assert len(refused) > 30
    assert all(code.startswith("markers.") for code in refused)
