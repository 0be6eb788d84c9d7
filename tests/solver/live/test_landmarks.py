"""Landmarks of a face that moves before a known camera, followed back to the face."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.made_landmarks import FilmedLandmarks
from solver.kinds.live_messages import GivenFrame
from solver.live.landmarks import LandmarkOptions, LiveLandmarks
from solver.live.perspective import Perspective, PerspectiveOptions
from solver.live.session import LiveOptions, LiveSession, arrays_of
from solver.similarity import Similarity, small_motion
from tests.solver.live.live_rig import follow, live_files

FRAMES = 90
RATE = 30.0
FAR = PerspectiveOptions(most=0.0)
WEIGHTS = {"jawOpen": 0.4, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.6, "browInnerUp": 0.8}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live")
    options = LiveOptions("landmarks", RATE, check_seconds=0)
    return LiveSession.open(live_files(folder), folder, options)


@pytest.fixture(scope="module")
def film(session):
    """Return skins (f, n, 3), heads, and the landmarks (f, 478, 3) that a near camera sees."""
    face = session.face
    middle = face.rig.model.skin.vertices[face.rig.model.face].mean(axis=0)
    camera = FilmedLandmarks(face.points, middle)
    skins, heads, landmarks = [], [], []
    for time in np.arange(FRAMES) / RATE:
        swing = 0.5 - 0.5 * np.cos(2.0 * time)
        values = np.array([swing * WEIGHTS.get(name, 0.0) for name in face.skin.names])
        skins.append(face.skin_of(face.amounts(values)))
        angles = 0.15 * np.sin(np.array([1.3, 0.9, 0.7]) * time)
        turn = small_motion(np.append(angles, np.zeros(3))).rotation
        heads.append(Similarity(1.0, turn, middle - turn @ middle))
        landmarks.append(camera.seen(skins[-1], heads[-1]))
    return np.array(skins), heads, landmarks


def test_landmarks_of_a_known_motion_are_followed_back_to_the_face(session, film):
    skins, heads, landmarks = film
    shown = session.face.rig.model.face
    off, turned = [], []
    for number, (skin, head, seen) in enumerate(zip(skins, heads, landmarks, strict=True)):
        frame = follow(session, GivenFrame(number, number / RATE, seen.tobytes()))
        arrays = arrays_of(frame, session.layout)
        followed = session.face.skin_of(arrays["amounts"])
        off.append(np.linalg.norm((followed - skin)[shown], axis=1).mean())
        matrix = arrays["head"]
        found = Similarity(1.0, matrix[:3, :3], matrix[:3, 3])
        turned.append(found.then(head.inverse()).degrees)
    still = np.linalg.norm((skins - session.face.rig.model.skin.vertices)[:, shown], axis=2)
    moves = still.mean(axis=1)[15:].mean()
    assert moves > 1.0
    assert np.mean(off[15:]) < 0.2 * moves
    assert np.mean(turned[15:]) < 1.0
    assert 1.0 / session.source.perspective.q == pytest.approx(450.0, rel=0.1)


def test_a_near_camera_is_found_and_makes_no_face(session, film):
    """A face that is taken for one of a far camera is farther off, by what only looks larger."""
    skins, _, landmarks = film
    face = session.face
    shown = face.rig.model.face
    about = (face.rig.model, face.skin.sliders, face.skin.reduced, face.points)
    usual = LandmarkOptions()
    off = []
    for options in (usual, replace(usual, perspective=FAR)):
        source = LiveLandmarks(*about, options)
        found = [source.step(each.astype(float), 1 / RATE).values for each in landmarks]
        followed = [face.skin_of(face.amounts(values)) for values in found]
        off.append(np.linalg.norm((followed - skins)[15:, shown], axis=2).mean())
    assert off[0] < 0.7 * off[1]


def test_a_cameras_distance_is_found_and_a_far_one_has_none():
    rng = np.random.default_rng(4)
    face = rng.uniform(-1.0, 1.0, (200, 3)) * [60.0, 80.0, 40.0]
    for q in (0.0, 1 / 400):
        perspective = Perspective()
        for _ in range(30):
            near = face.copy()
            near[:, :2] *= 1.0 + q * face[:, 2:]
            seen = 3.0 * (near + 0.5 * rng.standard_normal(face.shape)) + [100.0, 50.0, 0.0]
            seen[::9] = np.nan
            flat = perspective.flatten(seen, face, 1 / 30)
        assert perspective.q == pytest.approx(q, abs=1e-4)
        known = np.isfinite(seen).all(axis=1)
        beside = (flat - flat[known].mean(axis=0) - face + face[known].mean(axis=0))[known]
        assert np.abs(beside[:, :2]).mean() < 0.6
    perspective.begin()
    assert perspective.q == 0.0
