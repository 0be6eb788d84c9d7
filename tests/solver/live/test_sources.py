"""Weights, points and landmarks: followed back to what made them, whatever is missing of them."""

import numpy as np
import pytest

from solver.live.landmarks import COUNT, IMAGE_AXES
from solver.live.rigged import LiveFace
from solver.scans.live_link import ARKIT_NAMES
from solver.similarity import small_motion
from tests.solver.live.live_rig import live_files

SMILE = {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.6, "jawOpen": 0.4}


@pytest.fixture(scope="module")
def face(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live")
    return LiveFace.open(live_files(folder), folder)


@pytest.fixture(scope="module")
def values(face):
    return np.array([SMILE.get(name, 0.0) for name in face.skin.names])


def test_weights_are_the_values_of_their_expressions(face, values):
    source = face.source("weights")
    row = np.full((61, 1), np.nan)
    for name, weight in SMILE.items():
        row[ARKIT_NAMES.index(name)] = weight
    row[52:55, 0] = [0.2, -0.1, 0.05]
    frame = source.step(row, 1 / 60)
    np.testing.assert_allclose(frame.values, values)
    assert frame.head.degrees == pytest.approx(
        np.degrees(np.linalg.norm([0.2, 0.1, 0.05])), rel=0.05
    )
    gone = source.step(np.full((61, 1), np.nan), 1.0)
    assert gone.is_held
    np.testing.assert_allclose(gone.values, np.exp(-1.0) * values)
    assert gone.head is frame.head


def test_points_are_followed_with_their_head(face, values):
    source = face.source("points")
    head = small_motion(np.array([0.2, -0.3, 0.1, 30.0, -20.0, 10.0]))
    skin = face.skin_of(face.amounts(values))
    points = head(skin)
    points[::7] = np.nan
    points[face.rig.model.face[::11]] += 40.0
    for _ in range(8):
        frame = source.step(points, 1 / 60)
    off = (face.skin_of(face.amounts(frame.values)) - skin)[face.rig.model.face]
    assert np.linalg.norm(off, axis=1).mean() < 0.3
    assert frame.head.then(head.inverse()).degrees < 0.5
    assert not frame.is_held
    assert np.abs(frame.clues).max() < 5.0  # none of points that are wrong
    assert source.step(np.full_like(points, np.nan), 1 / 60).is_held


def test_landmarks_are_followed_by_a_camera_of_any_scale(face, values):
    source = face.source("landmarks")
    names = [name for name in face.points.names if name.isdecimal()]
    skin = face.skin_of(face.amounts(values))
    landmarks = np.full((COUNT, 3), np.nan)
    there = face.points.select(names).of(skin)
    landmarks[[int(name) for name in names]] = 3.7 * there @ IMAGE_AXES + [320.0, 240.0, 0.0]
    for _ in range(12):
        frame = source.step(landmarks, 1 / 30)
    off = (face.skin_of(face.amounts(frame.values)) - skin)[face.rig.model.face]
    moved = (skin - face.rig.model.skin.vertices)[face.rig.model.face]
    assert np.linalg.norm(off, axis=1).mean() < 0.25 * np.linalg.norm(moved, axis=1).mean()
    assert frame.head.degrees < 3.0
    few = np.full_like(landmarks, np.nan)
    few[:5] = landmarks[:5]
    assert source.step(few, 1 / 30).is_held
    for point in (0.0, 320.0):  # a detector that sees no face
        assert source.step(np.full_like(landmarks, point), 1 / 30).is_held
    assert not source.step(landmarks, 1 / 30).is_held


def test_contractions_are_those_of_the_pose(face, values):
    a = face.skin.sliders.pose(values).a
    np.testing.assert_allclose(
        face.contractions(values),
        np.nan_to_num(np.clip(face._contraction(a), -0.02, 0.5)),
        atol=1e-9,
    )
