"""What is known of a photograph: read in every form, checked against its picture, undistorted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.photo.camera import Lens
from solver.photo.facts import IBUG_MEDIAPIPE, read_facts
from solver.photo.picture import Picture
from solver.photo.read import read_photo
from solver.surface import Floats

ROOT = Path(__file__).parents[3]
WIDTH = 320
HEIGHT = 240
# A face from the front in px; the subject's left is on the right.
FACE = {
    "exocanthion_r": [110.0, 90.0],
    "endocanthion_r": [140.0, 92.0],
    "endocanthion_l": [180.0, 92.0],
    "exocanthion_l": [210.0, 90.0],
    "nose_tip": [160.0, 130.0],
    "cheilion_r": [135.0, 165.0],
    "cheilion_l": [185.0, 165.0],
}

CORNERS = {  # of eyes and mouth, by their numbers in MediaPipe's mesh
    33: "exocanthion_r",
    133: "endocanthion_r",
    362: "endocanthion_l",
    263: "exocanthion_l",
    61: "cheilion_r",
    291: "cheilion_l",
}


def _oval(column: float, row: float, wide: float, high: float, count: int = 24) -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    return np.column_stack([column + wide * np.cos(angle), row + high * np.sin(angle)])


CURVES = {
    "lips_outer": _oval(160, 165, 25, 9).tolist(),
    "lips_inner": _oval(160, 165, 20, 3).tolist(),
    "eye_right": _oval(125, 90, 14, 5).tolist(),
    "eye_left": _oval(195, 90, 14, 5)[:15].tolist(),  # partly behind hair
}
CAMERA = {
    "fx": 400.0,
    "fy": 410.0,
    "cx": 158.0,
    "cy": 121.0,
    "distortion": [0.0, 0.0, 0.0, 0.0, 0.0],
    "rotation": Rotation.from_euler("xyz", [180, 3, 2], degrees=True).as_matrix().round(6).tolist(),
    "translation": [10.0, -20.0, 600.0],
}
DOCUMENT = {"size": [WIDTH, HEIGHT], "camera": CAMERA, "landmarks": FACE, "curves": CURVES}


def _picture(folder: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    path = folder / "face.png"
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]]
    waves = [0.5 + 0.4 * np.sin(columns / 20.0), 0.5 + 0.4 * np.cos(rows / 15.0), rows / size[1]]
    Image.fromarray(np.uint8(255 * np.stack(waves, axis=2))).save(path)
    return path


def _facts(folder: Path, document: Any) -> Path:
    path = folder / "face.json"
    path.write_text(json.dumps(document))
    return path


def test_a_photograph_with_all_that_can_be_known(tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    Image.fromarray(np.uint8(255 * (np.mgrid[0:HEIGHT, 0:WIDTH][0] > 50))).save(mask)
    photo = read_photo(_picture(tmp_path), _facts(tmp_path, DOCUMENT), mask)
    assert (photo.name, photo.size, photo.focal_px) == ("face", (WIDTH, HEIGHT), None)
    assert photo.camera is not None
    assert photo.camera.focal.tolist() == [400.0, 410.0]
    assert photo.camera.centre.tolist() == [158.0, 121.0]
    np.testing.assert_allclose(photo.camera.rotation, CAMERA["rotation"], atol=1e-6)
    np.testing.assert_allclose(
        photo.camera.rotation @ photo.camera.rotation.T, np.eye(3), atol=1e-12
    )
    assert {name: place.tolist() for name, place in photo.landmarks.items()} == FACE
    assert {name: curve.tolist() for name, curve in photo.curves.items()} == CURVES
    assert photo.mask is not None
    assert photo.mask.sum() == WIDTH * (HEIGHT - 51)


def test_the_guide_s_example_is_read(tmp_path: Path) -> None:
    text = (ROOT / "docs/guide/capture-station.md").read_text(encoding="utf-8")
    example = text[text.index("    {\n") : text.index("    }\n") + 6]
    picture = Picture(np.zeros((3000, 4000, 3), np.float32), None, None, False, "JPEG")
    facts = read_facts(_facts(tmp_path, json.loads(example)), picture)
    assert facts.lens is not None
    assert len(facts.landmarks) == 4


def test_a_photograph_alone(tmp_path: Path) -> None:
    photo = read_photo(_picture(tmp_path))
    assert (photo.camera, photo.mask, photo.landmarks, photo.curves) == (None, None, {}, {})
    photo = read_photo(_picture(tmp_path), _facts(tmp_path, {}))
    assert (photo.camera, photo.mask, photo.landmarks, photo.curves) == (None, None, {}, {})
    bare = {"camera": {"fx": 400, "fy": 400}}
    camera = read_photo(_picture(tmp_path), _facts(tmp_path, bare)).camera
    assert camera is not None
    assert camera.centre.tolist() == [WIDTH / 2, HEIGHT / 2]
    assert (camera.rotation.tolist(), camera.translation.tolist()) == (np.eye(3).tolist(), [0] * 3)


def test_lists_of_landmarks(tmp_path: Path) -> None:
    """MediaPipe's are known by their numbers; of the 68 the jaw's outline is dropped."""
    picture = _picture(tmp_path)
    mesh: list[Any] = [[10.0 + 0.5 * row, 20.0 + 0.25 * row] for row in range(478)]
    mesh[3] = None
    for number, name in CORNERS.items():
        mesh[number] = FACE[name]
    for number in (70, 107, 336, 300, 98, 327, 0, 2, 13, 14, 17, 152):
        mesh[number] = None
    found = read_photo(picture, _facts(tmp_path, {"landmarks": mesh})).landmarks
    assert found["33"].tolist() == FACE["exocanthion_r"]
    assert len(found) == 478 - 13
    assert "3" not in found
    ibug: list[Any] = [None] * 68
    ibug[0] = [1.0, 1.0]  # of the jaw
    for row, name in zip((36, 39, 42, 45, 48, 54), CORNERS.values(), strict=True):
        ibug[row] = FACE[name]
    found = read_photo(picture, _facts(tmp_path, {"landmarks": ibug})).landmarks
    assert sorted(found) == ["133", "263", "291", "33", "362", "61"]
    assert found["61"].tolist() == FACE["cheilion_r"]


def test_both_schemes_are_alike_on_both_sides() -> None:
    """A point's twin in one scheme has the twin's number in the other, which each has once."""
    brows = {17: 26, 18: 25, 19: 24, 20: 23, 21: 22}
    eyes = {36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46}
    mouth = {48: 54, 49: 53, 50: 52, 59: 55, 58: 56, 60: 64, 61: 63, 67: 65}
    twins = {**brows, 31: 35, 32: 34, **eyes, **mouth}
    middle = {27, 28, 29, 30, 33, 51, 57, 62, 66}
    assert {*twins, *twins.values(), *middle} == {*IBUG_MEDIAPIPE} == {*range(17, 68)}
    assert len({*IBUG_MEDIAPIPE.values()}) == 51
    # MediaPipe numbers the left half above the right one
    assert all(
        int(IBUG_MEDIAPIPE[right]) < int(IBUG_MEDIAPIPE[left]) for right, left in twins.items()
    )


def test_names_of_a_template_of_ones_own(tmp_path: Path) -> None:
    named = {"landmarks": {**FACE, "scar": [200.0, 140.0]}}
    facts = _facts(tmp_path, named)
    assert "scar" in read_photo(_picture(tmp_path), facts, names=["scar"]).landmarks
    with pytest.raises(InputError, match="no template has a landmark 'scar'"):
        read_photo(_picture(tmp_path), facts)


@pytest.mark.parametrize(
    "distortion", [[-0.25, 0.08, 1e-3, -2e-3, 0.01], [0.2, 0.0, 0.0, 0.0, 0.0]]
)
def test_a_distorted_picture_is_undistorted_once(tmp_path: Path, distortion: list[float]) -> None:
    """What was at a pixel is where a pinhole sees it, landmarks and curves with it."""
    camera = {**CAMERA, "distortion": distortion}
    picture = _picture(tmp_path)
    before = read_photo(picture)
    photo = read_photo(picture, _facts(tmp_path, {**DOCUMENT, "camera": camera}))
    assert photo.camera is not None
    lens = Lens(photo.camera.focal, photo.camera.centre, np.array(distortion))
    for name, place in photo.landmarks.items():
        np.testing.assert_allclose(lens.distort(place[None])[0], FACE[name], atol=1e-6)
    for name, curve in photo.curves.items():
        np.testing.assert_allclose(lens.distort(curve), CURVES[name], atol=1e-6)
    places = np.array([[60.5, 40.5], [200.5, 180.5], [300.5, 20.5]])
    columns, rows = (places - 0.5).astype(int).T
    seen = photo.pixels[rows, columns]
    waves = lens.distort(places) - 0.5  # of the picture's pixels, by their numbers
    expected = np.column_stack(
        [0.5 + 0.4 * np.sin(waves[:, 0] / 20.0), 0.5 + 0.4 * np.cos(waves[:, 1] / 15.0)]
    )
    np.testing.assert_allclose(seen[:, :2], expected, atol=0.006)
    assert before.mask is None
    is_barrel = distortion[0] < 0
    assert (photo.mask is None) == is_barrel  # what a pincushion's lens did not see is not there


def _with(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        *parents, last = path.split(".")
        for part in parents:
            document = document[part]
        document[last] = value

    return change


EIGHT = [[130, 160], [190, 160], [190, 175], [130, 175], [130, 160]]
BOW = [[130, 155], [190, 175], [190, 155], [130, 175], [130, 155]]
DEGREES = Rotation.from_euler("y", 20, degrees=True).as_matrix()
MIRROR = np.diag([-1.0, 1.0, 1.0]).tolist()
SHEAR = [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
SHARES = {name: [x / WIDTH, y / HEIGHT] for name, (x, y) in FACE.items()}
LEFT_RIGHT = {"l": "r", "r": "l"}
OTHER_SIDE = {
    (f"{name[:-1]}{LEFT_RIGHT[name[-1]]}" if name[-2] == "_" else name): place
    for name, place in FACE.items()
}
ONE_PAIR = {**FACE, "cheilion_r": FACE["cheilion_l"], "cheilion_l": FACE["cheilion_r"]}


@pytest.mark.parametrize(
    ("path", "value", "code", "where"),
    [
        ("size", [HEIGHT, WIDTH], "size", "photo.size"),
        ("size", [640, 480], "size", "photo.size"),
        ("sizes", [640, 480], "facts_schema", "photo"),
        ("camera.fx", -400.0, "facts_schema", "photo.camera.fx"),
        ("camera.fx", float("nan"), "facts_schema", "photo.camera.fx"),
        ("camera.fx", 1.0, "camera", "photo.camera.fx"),
        ("camera.fy", 1e6, "camera", "photo.camera.fy"),
        ("camera.fy", 2000.0, "camera", "photo.camera.fy"),
        ("camera.cx", 900.0, "camera", "photo.camera.cx"),
        ("camera.cy", -300.0, "camera", "photo.camera.cy"),
        ("camera.rotation", MIRROR, "camera", "photo.camera.rotation"),
        ("camera.rotation", SHEAR, "camera", "photo.camera.rotation"),
        ("camera.rotation", [[0.0] * 3] * 3, "camera", "photo.camera.rotation"),
        ("camera.rotation", [10.0, 0.0, 0.0], "facts_schema", "photo.camera.rotation[0]"),
        ("camera.translation", None, "facts_schema", "photo.camera"),
        ("camera.distortion", [-8.0, 0, 0, 0, 0], "camera", "photo.camera.distortion"),
        ("camera.distortion", [0.0, 0, 0, 0, -1e4], "camera", "photo.camera.distortion"),
        ("camera.distortion", [0.1], "facts_schema", "photo.camera.distortion"),
        ("landmarks.nose_tip", [160.0, 241.0], "landmarks_outside", "photo.landmarks.nose_tip"),
        ("landmarks.nose_tip", [float("nan"), 2], "facts_schema", "photo.landmarks.nose_tip[0]"),
        ("landmarks.nose_tip", [1.0, 2.0, 3.0], "facts_schema", "photo.landmarks.nose_tip"),
        ("landmarks.nosetip", [160.0, 41.0], "landmarks_unknown", "photo.landmarks"),
        ("landmarks.478", [160.0, 41.0], "landmarks_unknown", "photo.landmarks"),
        ("landmarks", {}, "facts_schema", "photo.landmarks"),
        ("landmarks", {"nose_tip": [160, 130]}, "landmarks_few", "photo.landmarks"),
        ("landmarks", [None] * 68, "landmarks_few", "photo.landmarks"),
        ("landmarks", SHARES, "landmarks_few", "photo.landmarks"),
        ("landmarks", [[1, 2]] * 51, "facts_schema", "photo.landmarks"),
        ("landmarks", [[1, 2, 3]] * 478, "facts_schema", "photo.landmarks[0]"),
        ("landmarks", OTHER_SIDE, "swapped", "photo.landmarks.endocanthion_r"),
        ("landmarks", ONE_PAIR, "swapped", "photo.landmarks.cheilion_r"),
        ("curves.lips", EIGHT, "facts_schema", "photo.curves"),
        ("curves.lips_outer", [[1, 2], [30, 40]], "facts_schema", "photo.curves.lips_outer"),
        ("curves.lips_outer", [[1, 2]] * 9, "curve", "photo.curves.lips_outer"),
        ("curves.lips_outer", BOW, "curve", "photo.curves.lips_outer[0]"),
        ("curves.lips_outer", [*EIGHT, [-5, 20]], "curve", "photo.curves.lips_outer[5]"),
        ("curves.eye_left", CURVES["eye_right"], "swapped", "photo.curves.eye_right"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(
    tmp_path: Path, path: str, value: Any, code: str, where: str
) -> None:
    document = json.loads(json.dumps(DOCUMENT))
    _with(path, value)(document)
    if code == "swapped" and path.startswith("curves"):
        document["curves"]["eye_right"] = CURVES["eye_left"]
    with pytest.raises(InputError) as caught:
        read_photo(_picture(tmp_path), _facts(tmp_path, document))
    error = caught.value
    assert (error.code, error.context["where"]) == (f"photo.{code}", where), error.message
    assert error.context["file"] == "face.json"
    assert error.context["faults"][0]["where"] == where


def test_a_mirrored_face_is_refused(tmp_path: Path) -> None:
    mirrored = {name: [WIDTH - x, y] for name, (x, y) in FACE.items()}
    with pytest.raises(InputError, match="exchanged, or the picture is a mirror's"):
        read_photo(_picture(tmp_path), _facts(tmp_path, {"landmarks": mirrored}))


@pytest.mark.parametrize("angle", [90.0, 180.0, -60.0])
def test_a_face_may_lie_on_its_side(tmp_path: Path, angle: float) -> None:
    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()[:2, :2]
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    turned = {
        name: (turn @ (np.array(place) - (160, 125)) + middle).tolist()
        for name, place in FACE.items()
    }
    read_photo(_picture(tmp_path), _facts(tmp_path, {"landmarks": turned}))


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    document = json.loads(json.dumps(DOCUMENT))
    document["camera"]["cx"] = 5000.0
    document["landmarks"]["nosetip"] = [3.0, 4.0]
    document["landmarks"]["nose_tip"] = [3.0, 400.0]
    document["curves"]["lips_outer"] = BOW
    with pytest.raises(InputError, match="and 3 more") as caught:
        read_photo(_picture(tmp_path), _facts(tmp_path, document))
    faults = caught.value.context["faults"]
    assert [fault["code"] for fault in faults] == [
        "photo.landmarks_unknown",
        "photo.camera",
        "photo.landmarks_outside",
        "photo.curve",
    ]
    assert "nose_tip" in faults[0]["message"]


def test_lips_that_meet_may_be_traced_to_and_fro(tmp_path: Path) -> None:
    """A closed mouth's inner line runs there and back, and crosses itself by less than a pixel."""
    columns = np.linspace(135.0, 185.0, 11)
    upper = np.column_stack([columns, 165.0 + 0.4 * (-1.0) ** np.arange(11)])
    lower = np.column_stack([columns[::-1], 165.0 - 0.4 * (-1.0) ** np.arange(11)])
    curve = np.vstack([upper, lower, upper[:1]]).tolist()
    read_photo(_picture(tmp_path), _facts(tmp_path, {"curves": {"lips_inner": curve}}))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{", b"[" * 100_000, b" " * (2 << 20)])
def test_what_is_no_json_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "face.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_photo(_picture(tmp_path), path)
    assert (caught.value.code, caught.value.context["file"]) == (
        "photo.facts_unreadable",
        path.name,
    )


def test_a_mask_that_leaves_nothing_is_refused(tmp_path: Path) -> None:
    alpha = Image.new("RGBA", (WIDTH, HEIGHT), (90, 90, 90, 0))
    alpha.save(tmp_path / "clear.png")
    with pytest.raises(InputError, match="nothing of the picture is left"):
        read_photo(tmp_path / "clear.png")
