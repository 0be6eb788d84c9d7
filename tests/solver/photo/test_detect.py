"""Which face of a photograph is found, and what is said of one that is hard to use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.render import render
from solver.errors import InputError
from solver.photo.detect import Box, PhotoFace, detect, find_face
from solver.photo.photo import Photo
from solver.registration.detector import EYE_CORNERS, DetectedFace, FaceDetector
from tests.fixtures import face_landmarker, small_capture, small_model

WIDTH = 1200
HEIGHT = 800


class MarkedFaces:
    """Stands in for the detector: a pixel (1, eyes px / 1000, yaw deg / 90) is a face's middle."""

    def faces(self, picture: np.ndarray) -> list[DetectedFace]:
        found = []
        for row, column in np.argwhere(picture[:, :, 0] > 0):
            eyes = 1000 * picture[row, column, 1]
            turned = 90 * picture[row, column, 2]
            if eyes < picture.shape[1] / 12:
                continue
            points = np.random.default_rng(0).uniform(-0.7, 0.7, (478, 2)) * eyes
            points[list(EYE_CORNERS)] = [[-0.5 * eyes, 0.0], [0.5 * eyes, 0.0]]
            points[[0, 1]] = [[-0.7 * eyes, -0.7 * eyes], [0.7 * eyes, 0.7 * eyes]]
            turn = Rotation.from_euler("y", turned, degrees=True).as_matrix()
            found.append(DetectedFace(points + (column, row), turn))  # noqa: RUF005
        return found


def marked(*faces: tuple[int, int, float, float]) -> Photo:
    """Return a picture of faces at (column, row), their eyes so far apart, turned by degrees."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for column, row, eyes, turned in faces:
        pixels[row, column] = 1.0, eyes / 1000, turned / 90
    return Photo("group", pixels)


def found(photo: Photo, box: Box | None = None) -> PhotoFace:
    return find_face(photo, MarkedFaces(), box)  # type: ignore[arg-type]


def refusal(photo: Photo, box: Box | None = None) -> InputError:
    with pytest.raises(InputError) as caught:
        found(photo, box)
    assert caught.value.context["file"] == "group"
    return caught.value


def test_the_only_face_is_taken() -> None:
    face = found(marked((600, 400, 200, 0)))
    assert len(face.landmarks) == 478
    np.testing.assert_allclose(face.landmarks["33"], [500, 400], atol=1e-3)
    np.testing.assert_allclose(face.box, [460, 260, 740, 540], atol=1e-3)
    assert face.findings == ()


def test_of_several_faces_a_box_says_which() -> None:
    photo = marked((300, 400, 120, 0), (900, 300, 150, 0))
    refused = refusal(photo)
    assert refused.code == "photo.faces"
    assert refused.context["boxes"] == [[795, 195, 1005, 405], [216, 316, 384, 484]]
    for column, row in ((300, 400), (900, 300)):
        box = column - 80.0, row - 80.0, column + 90.0, row + 100.0
        face = found(photo, box)
        np.testing.assert_allclose(
            np.mean(face.landmarks["33"] + face.landmarks["263"]), column + row
        )
    assert refusal(photo, (500.0, 500.0, 700.0, 700.0)).code == "photo.no_face"
    assert refusal(photo, (2000.0, 0.0, 2100.0, 100.0)).code == "photo.no_face"


def test_bystanders_do_not_count() -> None:
    assert found(marked((300, 400, 300, 0), (900, 300, 90, 0))).box[0] < 300


def test_a_small_face_in_a_large_picture_is_seen() -> None:
    assert [finding.code for finding in found(marked((150, 150, 40, 0))).findings] == [
        "photo.small"
    ]


@pytest.mark.parametrize(
    ("face", "warned", "refused"),
    [
        ((600, 400, 61, 0), None, None),
        ((600, 400, 45, 0), "photo.small", None),
        ((600, 400, 29, 0), None, "photo.small"),
        ((600, 400, 200, 30), None, None),
        ((600, 400, 200, 45), "photo.profile", None),
        ((600, 400, 200, 55), None, "photo.profile"),
        ((100, 400, 200, 0), "photo.cut_off", None),
        ((0, 400, 200, 0), None, "photo.cut_off"),
    ],
)
def test_what_is_hard_to_use_is_told(
    face: tuple[int, int, float, float], warned: str | None, refused: str | None
) -> None:
    if refused is not None:
        assert refusal(marked(face)).code == refused
    else:
        codes = [finding.code for finding in found(marked(face)).findings]
        assert codes == ([] if warned is None else [warned])


def test_what_the_photograph_does_not_show_has_no_landmarks() -> None:
    photo = marked((600, 400, 200, 0))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :600] = True
    landmarks = found(replace(photo, mask=mask)).landmarks
    assert 150 < len(landmarks) < 330
    assert all(column < 600 for column, _ in landmarks.values())
    mask[:] = False
    with pytest.raises(InputError, match="hides all of the face") as caught:
        found(replace(photo, mask=mask))
    assert caught.value.code == "photo.mask_empty"
    cut = found(marked((100, 400, 200, 0))).landmarks
    assert len(cut) < 478
    assert all(column >= 0 for column, _ in cut.values())


@pytest.mark.long
def test_drawn_faces_are_found_where_they_are() -> None:
    """The small person smiles, side by side with herself, who is turned aside."""
    model = face_landmarker()
    smile = small_capture("smile").vertices
    drawn = DrawnHead(small_model().skin)
    face = small_model().face
    body = drawn.body(drawn.lit(smile))
    views = [render([body], face_camera(smile, face, yaw), 400, 400) for yaw in (0.0, 0.3)]
    photo = Photo("twins", np.hstack(views))
    with FaceDetector(model) as detector:
        with pytest.raises(InputError) as caught:
            find_face(photo, detector)
        assert caught.value.code == "photo.faces"
        assert len(caught.value.context["boxes"]) == 2
        straight = find_face(photo, detector, (0.0, 0.0, 400.0, 400.0))
        turned = find_face(photo, detector, (400.0, 0.0, 800.0, 400.0))
        assert straight.box[2] < 400 < turned.box[0]
        (alone,) = detect(views[1], detector)
        np.testing.assert_allclose(alone.box, np.subtract(turned.box, [400, 0, 400, 0]), atol=3.0)
        assert 10 < np.degrees(alone.yaw) < 20
        assert detect(np.full((300, 300, 3), 0.5, np.float32), detector) == []
