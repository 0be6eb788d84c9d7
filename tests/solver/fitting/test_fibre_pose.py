"""One path for every layout of controls: a face of fibre muscles fitted as one of S is."""

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions, DenseModel
from solver.fitting.calibration import fibre_muscles, with_fibres
from solver.fitting.face import Face, Pose
from solver.fitting.least_squares import bounded_step
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, SeenPoints
from solver.mechanics.flesh import MOONEY_RIVLIN
from tests.solver.simulation.test_fibres import fibred_block

JAW = np.array([0.08, 0.02, 0.3, -0.3, 0.2])


@pytest.fixture(scope="module")
def plain():
    return Face(fibred_block(), material=MOONEY_RIVLIN, tolerance=1e-12)


@pytest.fixture(scope="module")
def face(plain):
    return with_fibres(plain, fibre_muscles(plain, 8.0))


def pose(face, *a, part=1.0):
    return Pose(np.array(a), part * JAW, face.layout)


def data(face, state):
    return SkinDistance(face, Target.from_points(face.face_points(state.x)))


def light(face):
    return Regulariser(w_a=1e-8, w_v=0.0, w_b=1e-11, prior=face.rest_pose())


def test_sensitivities_match_equilibria_nearby(face):
    state = face.continuation(face.rest, pose(face, 0.6, 0.3))
    sensitivity = Sensitivity(face, state)
    exact = sensitivity.by_pose()
    rng = np.random.default_rng(2)
    step = 1e-5
    change = rng.standard_normal(face.layout.size)
    ends = [
        face.solve_equilibrium(
            Pose.of(face.layout, state.pose.vector() + sign * step * change), state.x
        ).x
        for sign in (1, -1)
    ]
    numeric = (ends[0] - ends[1])[face.flesh.free].ravel() / (2 * step)
    assert np.abs(numeric).max() > 1.0
    np.testing.assert_allclose(exact.flesh @ change, numeric, atol=1e-4 * np.abs(numeric).max())
    np.testing.assert_allclose(
        sensitivity.response.free_motion(sensitivity.pose, change), exact.flesh @ change, atol=1e-8
    )
    pull = rng.standard_normal(state.x.shape)
    by_adjoint = sensitivity.response.adjoint(sensitivity.pose, pull)
    np.testing.assert_allclose(by_adjoint, exact.adjoint(pull), rtol=1e-8, atol=1e-8)


def test_activations_and_jaw_come_back(face):
    truth = face.continuation(face.rest, pose(face, 0.7, 0.25))
    found = activation.fit(
        face, data(face, truth), light(face), options=ActivationOptions(40, tolerance=1e-10)
    ).state
    np.testing.assert_allclose(found.pose.a, truth.pose.a, atol=2e-3)
    np.testing.assert_allclose(found.pose.b, truth.pose.b, atol=2e-2)


def test_bounds_hold_exactly_and_ipopt_finds_the_same(plain, face):
    """A skin that takes more than a muscle's all."""
    strong = with_fibres(plain, fibre_muscles(plain, 14.0))
    truth = strong.continuation(strong.rest, pose(face, 0.9, 0.0))
    wanted = data(face, truth)
    prior = light(face)
    found = activation.fit(face, wanted, prior, options=ActivationOptions(40, tolerance=1e-10))
    assert found.state.pose.a[0] == 1.0
    assert 0.0 <= found.state.pose.a[1] <= 1.0
    full = reference.activations(face, wanted, prior, face.rest_pose(), face.model.rest)
    assert full.objective == pytest.approx(found.objective, rel=1e-3)
    np.testing.assert_allclose(full.pose.a, found.state.pose.a, atol=2e-3)


def test_a_step_within_bounds_is_cut_as_a_whole(face):
    """With its turn cut alone, a jaw that opens wide would be shifted in its place."""
    layout = face.layout
    rng = np.random.default_rng(5)
    root = rng.standard_normal((layout.size, layout.size))
    gradient = rng.standard_normal(layout.size)
    gradient[layout["jaw"]][0] = -30.0
    model = DenseModel(layout, root @ root.T + np.eye(layout.size), gradient, layout.rest)
    whole = model.step(0.0, np.inf).change
    assert layout.reach(whole) > 1.0
    part = model.step(0.0, 0.5).change
    np.testing.assert_allclose(part, 0.5 / layout.reach(whole) * whole, rtol=1e-12)
    assert (part[layout["fibres"]] >= 0.0).all()


def test_frames_are_followed(face):
    tracker = Tracker(DensePoints(face, light(face)))
    for number in range(1, 5):
        part = 0.2 * number
        truth = face.continuation(face.rest, pose(face, part, 0.5 * part, part=part))
        points = face.face_points(truth.x)
        tracker.step(SeenPoints(points, np.ones(len(points))))
        assert (tracker.state.pose.a >= 0.0).all()
        np.testing.assert_allclose(tracker.state.pose.a, truth.pose.a, atol=0.1)
        moved = np.linalg.norm(face.face_points(truth.x) - face.face_points(face.rest.x), axis=1)
        left = data(face, truth).target.distances(face.face_points(tracker.state.x))
        assert left.mean() < 0.05 * moved.mean()


@pytest.mark.parametrize("count", [5, 60])
def test_bounded_steps_are_the_least_of_all_within_bounds(count):
    rng = np.random.default_rng(8)
    root = rng.standard_normal((count, count))
    hessian = root @ root.T + 0.1 * np.eye(count)
    gradient = rng.standard_normal(count)
    low = [-0.1, 0.0, -np.inf, -0.05, 0.0]
    high = [0.1, 0.0, np.inf, 0.4, 0.3]
    limits = np.resize(low, count), np.resize(high, count)
    step = bounded_step(hessian, gradient, limits)
    assert (step >= limits[0]).all()
    assert (step <= limits[1]).all()
    slope = gradient + hessian @ step
    inside = (step > limits[0]) & (step < limits[1])
    assert inside.any()
    assert (~inside).sum() > 1
    np.testing.assert_allclose(slope[inside], 0.0, atol=1e-10)
    assert (slope[(step == limits[0]) & ~(step == limits[1])] > 0.0).all()
    assert (slope[(step == limits[1]) & ~(step == limits[0])] < 0.0).all()


def test_what_is_for_other_controls_is_refused_in_words(face):
    with pytest.raises(InputError, match="moved by fibres and jaw, not by activations") as caught:
        _ = face.layout["activations"]
    assert caught.value.code == "face.layout"
