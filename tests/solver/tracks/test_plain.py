"""Plain blendshapes: what they make of skin and flesh, and their weights found again."""

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.objective import SkinDistance, Target
from solver.tracks.basis import MuscleTracks
from solver.tracks.fit import TrackFitOptions, fit
from solver.tracks.plain import PlainFace
from tests.solver.tracks.block import block_shapes, tracked_block


@pytest.fixture(scope="module")
def face():
    model = tracked_block()
    return PlainFace(model, MuscleTracks.of(model, block_shapes(model)))


def test_a_shape_at_weight_one_is_that_shape(face):
    skin = face.face.model.skin.vertices
    shapes = block_shapes(face.face.model)
    for name, motion in shapes.items():
        state = face.move(face.rest(), face.tracks.controls({name: 1.0}))
        np.testing.assert_allclose(face.skin(state), skin + motion, atol=0.05)


def test_columns_are_the_derivatives(face):
    q = face.tracks.controls({"aside": 0.3, "open": 0.6}, np.array([0.05, 0.02, 0.3, 0.1, 0.2]))
    state = face.move(face.rest(), q)
    step = 1e-5
    columns = face.columns(state)
    for number, way in enumerate(np.eye(len(q))):
        ahead, behind = (face.move(state, q + sign * step * way).x for sign in (1, -1))
        np.testing.assert_allclose(columns[:, :, number], (ahead - behind) / (2 * step), atol=1e-7)


def test_weights_are_found_again_by_the_terms_of_tracks(face):
    truth = face.move(face.rest(), face.tracks.controls({"aside": 0.7, "bulge": 0.4, "open": 0.5}))
    data = SkinDistance(face.face, Target.from_points(face.face.face_points(truth.x)))
    found = fit(face, data, options=TrackFitOptions(w_w=1e-9, w_j=1e-2))
    np.testing.assert_allclose(found.point.q[:3], truth.q[:3], atol=0.02)
    assert data.value(found.point.x) < 1e-5 * data.value(face.rest().x)


def test_flesh_that_a_morph_turns_inside_out_is_counted(face):
    assert face.rest().inverted == 0
    state = face.move(face.rest(), face.tracks.controls({"aside": 30.0}))
    assert state.inverted > 0


def test_other_controls_are_refused(face):
    with pytest.raises(InputError, match="3 weights and five numbers of the jaw") as error:
        face.move(face.rest(), np.zeros(3))
    assert error.value.code == "tracks.controls"
