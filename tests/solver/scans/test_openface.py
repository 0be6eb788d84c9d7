"""Recordings of OpenFace: what is read, what is mended, and how a broken one is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.kinds.scene_recording import Recording
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.openface import GAZE, INTENSITIES, POSE, is_openface, read_openface
from solver.surface import Floats
from tests.fixtures import data_folder

CLOCK = ("frame", "face_id", "timestamp", "confidence", "success")
HEADER = [*CLOCK, *POSE, *INTENSITIES]
SMILE = "AU12_r"
OPEN = "AU26_r"


def rows(count: int, fps: float = 30.0, **given: list[Any]) -> list[dict[str, Any]]:
    """Return frames at rest, with columns ``given`` for all of them."""
    table = []
    for frame in range(count):
        row: dict[str, Any] = dict.fromkeys(HEADER, 0)
        row |= {"frame": frame + 1, "timestamp": round(frame / fps, 4)}
        row |= {"confidence": 0.98, "success": 1}
        table.append(row | {name: values[frame] for name, values in given.items()})
    return table


def write(path: Path, table: list[dict[str, Any]], header: list[str] = HEADER) -> Path:
    """Write frames as OpenFace does, with a blank before names."""
    lines = [", ".join(header), *(",".join(str(row[name]) for name in header) for row in table)]
    path.write_text("\n".join(lines) + "\n")
    return path


def read(path: Path, **options: Any) -> FaceTake:
    return read_openface(path, Recording(asset="take", **options))


def weight(take: FaceTake, name: str) -> Floats:
    return take.weights[:, ARKIT_NAMES.index(name)]


def codes(take: FaceTake) -> list[str]:
    return [notice.code for notice in take.notices]


def test_a_real_recording() -> None:
    path = data_folder("openface", "lara_au_pose.csv")
    assert is_openface(path)
    take = read(path)
    assert take.weights.shape == (2203, 52)
    assert np.median(np.diff(take.times)) == pytest.approx(1 / 30, abs=1e-3)
    assert take.seen.all()
    assert not take.notices
    assert not take.gaps
    assert weight(take, "jawOpen")[0] == pytest.approx(0.6 * 0.88 / 5.0)  # AU26 rests at 0
    for name in ARKIT_NAMES:
        if name.endswith("Left") and f"{name[:-4]}Right" in ARKIT_NAMES and "eyeLook" not in name:
            np.testing.assert_array_equal(weight(take, name), weight(take, f"{name[:-4]}Right"))


def test_the_head_turns_as_its_landmarks_do() -> None:
    """They are in the camera's axes: turned into the first frame's head, they turn as it does."""
    path = data_folder("openface", "lara_au_pose.csv")
    head = read(path, neutral=0).head[::20]
    with np.load(data_folder("openface", "lara_landmarks68_3d_mm.npz")) as data:
        points = data["landmarks"][::20].astype(np.float64)
    angles = np.loadtxt(path, delimiter=",", skiprows=1, max_rows=1)[7:10]
    points -= points.mean(axis=1, keepdims=True)
    points = points @ Rotation.from_euler("XYZ", angles).as_matrix() * [1, -1, -1]
    turns = np.array([Rotation.align_vectors(each, points[0])[0].as_rotvec() for each in points])
    assert np.degrees(np.abs(head)).max(axis=0).min() > 4.0
    for axis in range(3):
        slope = np.polyfit(head[:, axis], turns[:, axis], 1)[0]
        assert np.corrcoef(head[:, axis], turns[:, axis])[0, 1] > 0.8
        assert 0.7 < slope < 1.5


@pytest.mark.parametrize(
    ("column", "looks"),
    [
        ("pose_Rx", (0.0, -np.sin(0.3), np.cos(0.3))),  # down
        ("pose_Ry", (-np.sin(0.3), 0.0, np.cos(0.3))),  # to the subject's right
    ],
)
def test_a_head_looks_where_openface_says(
    column: str, looks: tuple[float, ...], tmp_path: Path
) -> None:
    take = read(write(tmp_path / "a.csv", rows(2, **{column: [0.1, 0.4]})), neutral=0)
    gaze = Rotation.from_rotvec(take.head).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(gaze, [(0.0, 0.0, 1.0), looks], atol=1e-12)


def test_eyes_look_where_the_gaze_goes_in_the_head(tmp_path: Path) -> None:
    """To the image's right, which is the subject's left; and straight on by the head's turn."""
    x = [0.0, np.sin(0.2), np.sin(0.2)]
    z = [-1.0, -np.cos(0.2), -np.cos(0.2)]
    given: dict[str, list[Any]] = dict.fromkeys(GAZE, [0.0] * 3)
    given |= {"gaze_0_x": x, "gaze_1_x": x, "gaze_0_z": z, "gaze_1_z": z}
    table = rows(3, pose_Ry=[0.0, 0.0, -0.2], **given)
    take = read(write(tmp_path / "a.csv", table, [*HEADER, *GAZE]), neutral=0)
    gaze = Rotation.from_rotvec(take.eyes[:, 0]).apply([0.0, 0.0, 1.0])
    ahead = (0.0, 0.0, 1.0)
    expected = [ahead, (np.sin(0.2), 0.0, np.cos(0.2)), ahead]
    np.testing.assert_allclose(gaze, expected, atol=1e-12)
    np.testing.assert_array_equal(take.eyes[:, 0], take.eyes[:, 1])


def test_what_a_face_has_at_rest_is_taken_off(tmp_path: Path) -> None:
    given = {SMILE: [0.5, 1.5, 3.0], OPEN: [0.0, 0.0, 5.0]}
    path = write(tmp_path / "a.csv", rows(3, **given))
    take = read(path, neutral=1)
    np.testing.assert_allclose(weight(take, "mouthSmileLeft"), [0.0, 0.0, 0.3])
    np.testing.assert_allclose(weight(take, "jawOpen"), [0.0, 0.0, 0.6])
    np.testing.assert_allclose(
        weight(read(path, neutral=0, gain=2), "mouthSmileRight"), [0.0, 0.4, 1.0]
    )
    by_range = read(path, neutral=0, gain="range")
    np.testing.assert_allclose(weight(by_range, "mouthSmileLeft"), [0.0, 0.4, 1.0])
    assert codes(by_range) == ["openface.range"]


def test_an_automatic_neutral_is_low_in_the_take(tmp_path: Path) -> None:
    smile = [1.0] * 20 + [4.0] * 10
    take = read(write(tmp_path / "a.csv", rows(30, **{SMILE: smile, "pose_Rx": [0.3] * 30})))
    np.testing.assert_allclose(weight(take, "mouthSmileLeft")[[0, -1]], [0.0, 0.6])
    assert np.abs(take.head).max() < 1e-9


def test_a_file_of_any_form_is_read_the_same(tmp_path: Path) -> None:
    table = rows(4, **{SMILE: [0.0, 1.0, 2.0, "-nan(ind)"], "success": [1, 1, 1, 0]})
    expected = read(write(tmp_path / "a.csv", table))
    header = [*HEADER[::-1], "x_0"]
    other = write(tmp_path / "b.csv", [row | {"x_0": "7.5"} for row in table], header)
    text = other.read_text().replace("\n", ",\r\n")
    other.write_bytes(b"\xef\xbb\xbf" + text.encode())
    found = read(other)
    np.testing.assert_array_equal(found.weights, expected.weights)
    np.testing.assert_array_equal(found.times, expected.times)
    np.testing.assert_array_equal(found.seen, [True, True, True, False])


def test_short_gaps_are_crossed_and_long_ones_come_to_rest(tmp_path: Path) -> None:
    smile: list[Any] = [5.0] * 60
    smile[3:5] = ["nan"] * 2
    smile[20:44] = [0.0] * 24
    confidence = [0.98] * 20 + [0.5] * 24 + [0.98] * 14 + [0.1] * 2
    table = rows(60, **{SMILE: smile, "confidence": confidence})
    table[0][SMILE] = 0.0
    take = read(write(tmp_path / "a.csv", table), neutral=0)
    played = weight(take, "mouthSmileLeft")
    assert take.seen.sum() == 60 - 28
    np.testing.assert_allclose(played[1:20], 1.0)
    assert played[32] == 0.0  # more than 0.25 s from both ends
    assert (np.diff(played[19:28]) <= 0.0).all()
    assert 0.0 < played[22] < 1.0
    assert (np.diff(played[36:45]) >= 0.0).all()
    assert played[58] > played[59] > 0.0
    assert codes(take) == ["openface.gaps"]
    assert take.notices[0].context["gaps"] == 3
    assert max(take.gaps) == pytest.approx(25 / 30, abs=1e-3)


def test_a_rate_takes_the_place_of_a_clock(tmp_path: Path) -> None:
    path = write(tmp_path / "pictures.csv", rows(5, fps=1000.0))
    with pytest.raises(InputError, match=r"1000 frames a second.*fps") as caught:
        read(path)
    assert caught.value.code == "openface.clock"
    np.testing.assert_allclose(read(path, fps=25).times, np.arange(5) / 25)
    bare = write(tmp_path / "bare.csv", rows(5), [*POSE, *INTENSITIES])
    with pytest.raises(InputError) as caught:
        read(bare)
    assert caught.value.code == "openface.clock"
    np.testing.assert_allclose(read(bare, fps=50).times, np.arange(5) / 50)


def test_a_folder_of_real_pictures_needs_a_rate() -> None:
    path = data_folder("openface", "OpenFace_Test.csv")
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.code == "openface.clock"
    take = read(path, fps=25)
    assert take.times[-1] == pytest.approx(99 / 25)
    assert take.seen.all()
    assert np.degrees(np.linalg.norm(take.head, axis=1)).max() < 10.0  # the camera's pitch is off


def test_one_face_of_several_is_chosen(tmp_path: Path) -> None:
    first = rows(3, **{SMILE: [0, 2, 2]})
    second = rows(3, **{SMILE: [0, 4, 4]})
    both = [each for pair in zip(first, second, strict=True) for each in pair]
    for number, row in enumerate(both):
        row["face_id"] = number % 2
    path = write(tmp_path / "a.csv", both)
    for face, smile in ((0, 0.4), (1, 0.8)):
        assert weight(read(path, face=face, neutral=0), "mouthSmileLeft")[2] == pytest.approx(smile)
    for options in ({}, {"face": 7}):
        with pytest.raises(InputError, match="0, 1") as caught:
            read(path, **options)
        assert caught.value.code == "openface.faces"


def test_a_scale_is_asked_for_where_it_is_in_doubt(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", rows(2, **{SMILE: [0.0, 0.5]}))
    take = read(path, neutral=0)
    assert codes(take) == ["openface.scale"]
    assert weight(take, "mouthSmileLeft")[1] == pytest.approx(0.1)
    for scale, smile in ((1, 0.5), (5, 0.1)):
        take = read(path, neutral=0, au_scale=scale)
        assert not take.notices
        assert weight(take, "mouthSmileLeft")[1] == pytest.approx(smile)


def test_intensities_beyond_their_scale_are_clipped_and_counted(tmp_path: Path) -> None:
    take = read(write(tmp_path / "a.csv", rows(2, **{SMILE: [-1.0, 7.0]})), neutral=0)
    np.testing.assert_allclose(weight(take, "mouthSmileLeft"), [0.0, 1.0])
    assert codes(take) == ["openface.clipped"]
    assert take.notices[0].context["count"] == 2


@pytest.mark.parametrize(
    ("given", "code", "line", "column"),
    [
        ({SMILE: [0, 0, "much"]}, "value", 4, SMILE),
        ({SMILE: [0, '"1,5"', 0]}, "value", 3, SMILE),
        ({SMILE: [0, "1,5", 0]}, "value", 3, str(len(HEADER) + 1)),
        ({"AU45_r": [0, "inf", 0]}, "value", 3, "AU45_r"),
        ({"pose_Rz": [0, 0, 30]}, "value", 4, "pose_Rz"),
        ({"timestamp": [0, 0.03, "nan"]}, "value", 4, "timestamp"),
        ({"timestamp": [0, 0.03, 0.03]}, "time_order", 4, "timestamp"),
        ({"timestamp": [0.03, 0, 0.06]}, "time_order", 3, "timestamp"),
        ({"success": [0, 0, 0]}, "no_face", None, None),
        ({SMILE: ["nan"] * 3}, "no_face", None, None),
        ({"timestamp": [0, 0, 0]}, "clock", None, None),
    ],
)
def test_a_broken_recording_names_line_and_column(
    given: dict[str, list[Any]], code: str, line: int | None, column: str | None, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"take\.csv") as caught:
        read(write(tmp_path / "take.csv", rows(3, **given)))
    assert caught.value.code == f"openface.{code}"
    assert caught.value.context.get("line") == line
    assert caught.value.context.get("column") == column


def test_a_short_row_names_the_first_column_that_it_lacks(tmp_path: Path) -> None:
    path = write(tmp_path / "take.csv", rows(2))
    path.write_text("\n".join(path.read_text().splitlines()[:2]) + "\n3,0,0.0667\n")
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.code == "openface.value"
    assert (caught.value.context["line"], caught.value.context["column"]) == (3, "confidence")


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (", ".join(HEADER), "unreadable"),
        ("frame, pose_Rx, pose_Ry, pose_Rz\n1,0,0,0\n", "columns"),
        ("AU12_r, \0\xff\n", "unreadable"),
    ],
)
def test_what_is_no_recording_is_refused(content: str, code: str, tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    path.write_bytes(content.encode("latin-1"))
    assert is_openface(path)
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.code == f"openface.{code}"


@pytest.mark.parametrize("neutral", [3, 1])
def test_a_neutral_must_be_a_frame_with_a_face(neutral: int, tmp_path: Path) -> None:
    path = write(tmp_path / "take.csv", rows(3, success=[1, 0, 1]))
    with pytest.raises(InputError) as caught:
        read(path, neutral=neutral)
    assert caught.value.code == "openface.neutral"
