"""Weights of tracks, found again from the skin that they make."""

import numpy as np
import pytest

from solver.fitting.objective import SkinDistance, Target
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace
from solver.tracks.fit import TrackFitOptions, _ShapeProblem, fit
from tests.solver.tracks.block import block_shapes, tracked_block

EXACT = {"stiffness_pa": 1.0, "tolerance": 1e-12, "settled_mm": 0.0}
FREE = TrackFitOptions(w_w=1e-9, w_j=1e-2, bounds=(-np.inf, np.inf))
BOUNDED = TrackFitOptions(w_w=1e-9, w_j=1e-2)


@pytest.fixture(scope="module")
def face():
    model = tracked_block()
    return TrackFace(model, MuscleTracks.of(model, block_shapes(model)), **EXACT)


def scan_of(face, **weights):
    """Return controls by their names, and the term of the skin that they make."""
    state = face.move(face.rest(), face.tracks.controls(weights))
    return state, SkinDistance(face.face, Target.from_points(face.face.face_points(state.x)))


def test_weights_are_found_again(face):
    truth, data = scan_of(face, aside=0.7, bulge=0.4, open=0.5)
    found = fit(face, data, options=BOUNDED)
    np.testing.assert_allclose(found.point.q[:3], truth.q[:3], atol=0.02)
    assert data.value(found.point.x) < 1e-5 * data.value(face.rest().x)
    # a frame that is near begins with the one before
    near = fit(face, data, found.point, BOUNDED)
    assert near.steps < found.steps


def test_bounds_are_kept_exactly(face):
    truth, data = scan_of(face, aside=1.3, bulge=-0.3)
    free, bounded = (fit(face, data, options=each) for each in (FREE, BOUNDED))
    np.testing.assert_allclose(free.point.q[:2], truth.q[:2], atol=0.02)
    assert bounded.point.q[0] == 1.0
    assert bounded.point.q[1] == 0.0
    assert bounded.value > free.value


def test_the_model_s_gradient_is_that_of_the_objective(face):
    _, data = scan_of(face, aside=0.7, bulge=0.4, open=0.5)
    problem = _ShapeProblem(face, data, TrackFitOptions(w_t=0.1), face.rest().q)
    state = face.move(face.rest(), face.tracks.controls({"aside": 0.2, "bulge": 0.3}))
    gradient = problem.linearise(state).gradient
    assert np.abs(gradient).max() > 1e-2
    step = 1e-4
    for number in range(len(gradient)):
        change = step * np.eye(len(gradient))[number]
        ahead, behind = (problem.value(face.move(state, state.q + s * change)) for s in (1, -1))
        expected = (ahead - behind) / (2.0 * step)
        assert gradient[number] == pytest.approx(expected, rel=1e-4, abs=1e-6)
