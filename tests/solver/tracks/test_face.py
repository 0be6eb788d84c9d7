"""The face of tracks: rest is rest, shapes are reached, and what cannot be is refused."""

import numpy as np
import pytest

from solver.errors import InputError
from solver.mechanics.boundary import move_jaw
from solver.tracks.basis import MuscleTracks, TrackOptions
from solver.tracks.face import TrackFace
from tests.solver.tracks.block import OPEN, block_shapes, tracked_block


@pytest.fixture(scope="module")
def model():
    return tracked_block()


@pytest.fixture(scope="module")
def face(model):
    return TrackFace(model, MuscleTracks.of(model, block_shapes(model)))


def test_rest_is_rest(model, face):
    rest = face.rest()
    assert np.abs(rest.x - model.rest).max() < 1e-9
    assert np.abs(face.skin(rest) - model.skin.vertices).max() < 1e-9
    assert rest.inverted == 0
    again = face.move(rest, np.zeros(face.tracks.size))
    assert np.abs(again.x - model.rest).max() < 1e-9


def test_shapes_are_reached_as_far_as_muscles_hold_them(model):
    shapes = block_shapes(model)
    rest_off = {}
    for length in (0.5, 4.0):
        tracks = MuscleTracks.of(model, shapes, TrackOptions(length_mm=length))
        face = TrackFace(model, tracks)
        for name, motion in shapes.items():
            state = face.move(face.rest(), tracks.controls({name: 1.0}))
            off = np.linalg.norm(face.skin(state) - model.skin.vertices - motion, axis=1)
            rest_off[name, length] = off[model.embedded].mean()
            assert state.inverted == 0
            moved = np.linalg.norm(motion[model.embedded], axis=1).mean()
            if length == 0.5:
                assert rest_off[name, length] < 0.2 * moved
    for name in shapes:
        assert rest_off[name, 0.5] < 0.5 * rest_off[name, 4.0]


def test_jaw_and_teeth_go_where_shapes_and_the_jaw_itself_say(model, face):
    state = face.move(face.rest(), face.tracks.controls({"open": 1.0}))
    assert np.allclose(state.drive.jaw, OPEN, atol=1e-8)
    mandible = model.rest[model.mandible]
    assert np.allclose(state.x[model.mandible], move_jaw(model.jaw, mandible, OPEN))
    half = face.tracks.controls({"open": 0.5}, 0.5 * OPEN)
    other = face.move(face.rest(), half)
    assert np.allclose(other.drive.jaw, OPEN, atol=1e-8)


def test_a_state_is_the_same_whichever_way_it_is_come_to(face):
    rest = face.rest()
    q = face.tracks.controls({"aside": 0.8, "open": 0.6})
    there = face.move(rest, q)
    around = face.move(face.move(rest, face.tracks.controls({"bulge": 1.0})), q)
    assert np.abs(there.x - rest.x).max() > 1.0
    assert np.abs(there.x - around.x).max() < 0.01


@pytest.mark.parametrize("q", [np.zeros(3), np.full(8, np.nan)])
def test_other_controls_are_refused(face, q):
    with pytest.raises(InputError) as error:
        face.move(face.rest(), q)
    assert error.value.code == "tracks.controls"


def test_tracks_of_another_model_are_refused(face):
    with pytest.raises(InputError) as error:
        TrackFace(tracked_block((4, 4, 3)), face.tracks)
    assert error.value.code == "tracks.model"
