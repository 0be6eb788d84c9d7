"""Tracks of a whole head: shapes are reached, volume is kept, and lips meet without crossing."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from solver.contact import Gauge
from solver.contact.barrier import Barrier
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.response import TrackResponse
from tests.fixtures import small_capture, small_model

pytestmark = pytest.mark.long

MODEL = small_model()
NEUTRAL = MODEL.skin.vertices
LIPS = {side: MODEL.region(f"{side}_lip") for side in ("upper", "lower")}


def pressed():
    """Return a shape whose lips go through each other by three millimetres."""
    motion = np.zeros_like(NEUTRAL)
    away = {side: cKDTree(NEUTRAL[ids]).query(NEUTRAL)[0] for side, ids in LIPS.items()}
    nearer = away["upper"] < away["lower"]
    fades = np.exp(-((np.minimum(*away.values()) / 8.0) ** 2))
    motion[:, 1] = np.where(nearer, -1.5, 1.5) * fades
    for rigid in ("upper_teeth", "lower_teeth", "left_eyeball", "right_eyeball"):
        motion[MODEL.region(rigid)] = 0.0
    motion[MODEL.attached_mandible] = 0.0
    return motion


SHAPES = {name: small_capture(name).vertices - NEUTRAL for name in ("smile", "surprise", "ah")}
SHAPES["press"] = pressed()
FLESH = MODEL.tets[
    cKDTree(NEUTRAL[np.concatenate(list(LIPS.values()))]).query(MODEL.tet_centres)[0] < 5.0
]


def lip_volume(x):
    return np.linalg.det(x[FLESH[:, 1:]] - x[FLESH[:, :1]]).sum()


@pytest.fixture(scope="module")
def face():
    tracks = MuscleTracks.of(MODEL, SHAPES)
    return TrackFace(MODEL, tracks, track_potentials(MODEL))


@pytest.fixture(scope="module")
def gauge(face):
    return Gauge(MODEL, potentials=face.potentials)


@pytest.mark.parametrize("name", ["smile", "surprise", "ah"])
def test_a_shape_is_reached_with_the_volume_of_the_lips(face, gauge, name):
    state = face.move(face.rest(), face.tracks.controls({name: 1.0}))
    moved = np.linalg.norm(SHAPES[name][MODEL.face], axis=1).mean()
    off = np.linalg.norm((face.skin(state) - NEUTRAL - SHAPES[name])[MODEL.face], axis=1).mean()
    assert moved > 3.0
    assert off < 0.13 * moved
    assert state.inverted == 0
    assert abs(lip_volume(state.x) / lip_volume(MODEL.rest) - 1.0) < 0.01
    # which is more than can be said of the shape itself
    assert face.face.flesh.count_inverted(state.pose.target) > 0
    assert gauge.at(state.x, state.drive.jaw).most < 0.1


def test_lips_that_a_shape_drives_through_each_other_meet(face, gauge):
    state = face.move(face.rest(), face.tracks.controls({"press": 1.0}))
    plain, flesh = (gauge.at(x, state.drive.jaw) for x in (state.pose.target, state.x))
    assert plain.lips > 1.0
    assert flesh.most < 0.1
    assert state.inverted == 0
    assert abs(lip_volume(state.x) / lip_volume(MODEL.rest) - 1.0) < 0.03


def test_derivatives_hold_where_lips_are_pressed():
    """Central differences of a hundred-thousandth of a millimetre: contact is that stiff."""
    tracks = MuscleTracks.of(MODEL, SHAPES)
    potentials = track_potentials(MODEL)
    face = TrackFace(MODEL, tracks, potentials, tolerance=1e-12, settled_mm=0.0)
    q = tracks.controls({"press": 0.6, "smile": 0.3})
    state = face.move(face.move(face.rest(), q), q)
    assert sum(each.contacts(state.x) for each in potentials if isinstance(each, Barrier)) > 10
    columns = TrackResponse(face, state).columns()
    for number in range(tracks.size):
        size = np.abs(columns[:, :, number]).max()
        step = 1e-4 / size * np.eye(tracks.size)[number]
        ahead, behind = (face.move(state, q + sign * step).x for sign in (1, -1))
        expected = (ahead - behind) / (2.0 * step[number])
        assert size > 0.3
        np.testing.assert_allclose(columns[:, :, number], expected, atol=1e-4 * size)
