"""Steps of the Gauss-Newton model against a dense solve, whatever matrix they begin with."""

import numpy as np
import pytest

from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.activation import (
    ActivationOptions,
    DenseModel,
    DescentOptions,
    GaussNewton,
    LearntMatrix,
)
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from tests.fixtures import small_capture, small_model
from tests.solver.block import block_model, poses

DAMPING = 1e-3


@pytest.fixture(scope="module")
def problem():
    """A face in one pose that is fitted to the skin of another one."""
    face = Face(block_model())
    here, there = (face.continuation(face.rest, pose) for pose in poses(2))
    data = SkinDistance(face, Target.from_points(face.face_points(there.x)))
    regulariser = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    return face, data, regulariser, here, activation.rest_curvature(face)


def dense(pose, hessian, gradient):
    return DenseModel(pose.layout, hessian, gradient, pose.vector()).step(DAMPING, np.inf).change


def exact(face, data, regulariser, state):
    hessian = activation.curvature(face, data, state) + regulariser.gauss_newton(state.pose)
    jacobian = Sensitivity(face, state).by_pose()
    gradient = jacobian.adjoint(data.gradient(state.x)) + regulariser.gradient(state.pose)
    step = (
        DenseModel(state.pose.layout, hessian, gradient, state.pose.vector())
        .step(DAMPING, np.inf)
        .change
    )
    return hessian, gradient, step


def test_step_is_that_of_the_exact_matrix(problem):
    *parts, matrix = problem
    hessian, gradient, step = exact(*parts)
    # the matrix it begins with leads elsewhere
    wrong = matrix + parts[2].gauss_newton(parts[3].pose)
    elsewhere = dense(parts[3].pose, wrong, gradient)
    assert np.abs(elsewhere - step).max() > 0.05 * np.abs(step).max()
    found = GaussNewton(*parts, LearntMatrix.of(matrix), DescentOptions(accuracy=1e-6)).step(
        DAMPING, np.inf
    )
    np.testing.assert_allclose(found.change, step, atol=1e-3 * np.abs(step).max())
    gain = -gradient @ step - 0.5 * step @ hessian @ step
    assert found.gain == pytest.approx(gain, rel=1e-4)
    sensitivity = Sensitivity(parts[0], parts[3])
    response = sensitivity.response.free_motion(sensitivity.pose, found.change)
    np.testing.assert_allclose(found.response, response, rtol=1e-9)


def test_matrix_learns_what_the_step_needed(problem):
    *parts, matrix = problem
    model = GaussNewton(*parts, LearntMatrix.of(matrix))
    model.step(DAMPING, np.inf)
    _, gradient, step = exact(*parts)
    known = parts[2].gauss_newton(parts[3].pose)
    errors = [
        np.abs(dense(parts[3].pose, each + known, gradient) - step).max()
        for each in (matrix, model.learnt.matrix)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_step_is_cut_to_the_trust(problem):
    *parts, matrix = problem
    _, gradient, step = exact(*parts)
    whole = parts[3].pose.layout.reach(step)
    found = GaussNewton(*parts, LearntMatrix.of(matrix)).step(DAMPING, 0.1 * whole)
    assert found.reach == pytest.approx(0.1 * whole, rel=1e-9)
    assert 0.0 < found.gain < -gradient @ found.change


@pytest.mark.long
@pytest.mark.parametrize(("expression", "draw"), [("smile", 0), ("surprise", 3), ("ah", 6)])
def test_few_points_are_fitted_from_rest(expression, draw):
    """With 40 of 1,849 points K is singular; it has to stay positive semi-definite as it learns."""
    face = Face(small_model())
    points = small_capture(expression).vertices[face.model.face]
    weights = np.zeros(len(points))
    rng = np.random.default_rng(1)
    chosen = [rng.choice(len(points), 40, replace=False) for _ in range(draw + 1)]
    weights[chosen[draw]] = 1.0
    data = SkinDistance(face, Target.from_points(points, weights))
    prior = activation.unseen_regulariser(face)
    matrix = activation.curvature(face, data, face.rest)
    options = ActivationOptions(max_iterations=25, tolerance=1e-3)
    fit = activation.fit(face, data, prior, options=options, matrix=matrix)
    assert fit.objective < 0.3 * activation.objective(data, prior, face.rest)


def test_a_model_that_is_not_finite_has_no_step(problem):
    face, *_ = problem
    pose = face.rest_pose()
    size = face.layout.size
    for hessian, gradient in (
        (np.eye(size), np.full(size, np.nan)),
        (np.full((size, size), np.nan), np.ones(size)),
    ):
        with pytest.raises(SolveError):
            dense(pose, hessian, gradient)


def test_step_within_bounds_is_the_best_of_the_exact_matrix():
    """From a matrix that leads elsewhere: what holds the step at its bounds is found on the way."""
    face = Face(block_model()).driven_by(Admissible(AdmissibleLimits(volume=1.02)))
    start = face.rest
    goal = face.continuation(face.rest, poses(2)[1])
    data = SkinDistance(face, Target.from_points(face.face_points(goal.x)))
    regulariser = Regulariser(1e-4, 1e-3, 1e-6, face.rest_pose())
    hessian, gradient, step = exact(face, data, regulariser, start)
    free = np.linalg.solve(hessian, -gradient)
    assert not face.layout.bounds.contains(start.pose.vector() + free)
    learnt = LearntMatrix.of(activation.curvature(face, data, start) + 0.3 * np.eye(len(step)))
    model = GaussNewton(face, data, regulariser, start, learnt, DescentOptions(accuracy=1e-3))
    found = model.step(DAMPING, np.inf).change
    assert face.layout.bounds.contains(start.pose.vector() + found)
    best, gain = (-(gradient @ s + 0.5 * s @ hessian @ s) for s in (step, found))
    assert gain > 0.98 * best > 0.0
