"""The equilibrium's derivatives by a, b and S against differences of solved equilibria."""

import numpy as np
import pytest

from solver.fitting.face import Face, Pose
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.simplex import replace_values
from tests.solver.block import block_model

STEP = 1e-5


@pytest.fixture(scope="module")
def posed():
    """A face far from rest: random activations that commute with no strain, the jaw open."""
    face = Face(block_model(), tolerance=1e-13)
    S = face.model.weights
    rng = np.random.default_rng(11)
    a = face.rest_pose().a + 0.3 * rng.standard_normal((2, 6))
    pose = Pose(a, np.array([0.12, 0.05, 0.5, -1.0, 0.8]))
    state = face.continuation(face.rest, pose)
    assert np.abs(state.x - face.model.rest).max() > 3.0
    return face, S, state, rng


def differences(forward, backward):
    return ((forward.x - backward.x) / (2 * STEP)).ravel()


def test_by_pose(posed):
    face, _, state, rng = posed
    jacobian = Sensitivity(face, state).by_pose()
    numeric = np.empty((state.x.size, 17))
    for column in range(17):
        step = np.zeros(17)
        step[column] = STEP
        poses = [
            Pose(state.pose.a + s * step[:12].reshape(2, 6), state.pose.b + s * step[12:])
            for s in (1, -1)
        ]
        numeric[:, column] = differences(*(face.solve_equilibrium(pose, state.x) for pose in poses))
        assert np.abs(numeric[:, column]).max() > 1e-2
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(jacobian.flesh, numeric[jacobian.free], atol=1e-6 * scale)
    gradient = rng.standard_normal(state.x.shape)
    np.testing.assert_allclose(
        jacobian.adjoint(gradient), numeric.T @ gradient.ravel(), rtol=1e-5, atol=1e-5 * scale
    )
    products = Sensitivity(face, state)
    adjoint = products.response.adjoint(products.pose, gradient)
    np.testing.assert_allclose(adjoint, jacobian.adjoint(gradient), rtol=1e-9)
    change = rng.standard_normal(17)
    np.testing.assert_allclose(
        products.response.free_motion(products.pose, change), jacobian.flesh @ change, rtol=1e-9
    )
    points = rng.standard_normal((len(face.model.face), 3)) + face.face_points(state.x)
    curvature = SkinDistance(face, Target.from_points(points)).curvature(state.x)
    exact = numeric.T @ (curvature @ numeric)
    np.testing.assert_allclose(jacobian.contract(curvature), exact, atol=1e-5 * np.abs(exact).max())


def test_by_geometry_and_its_adjoint(posed):
    face, S, state, rng = posed
    products = Sensitivity(face, state)
    response = products.response
    weights = products.weights
    change = rng.standard_normal(len(S.data))
    changed = [replace_values(S, S.data + sign * STEP * change) for sign in (1, -1)]
    numeric = differences(
        *(face.with_weights(T).solve_equilibrium(state.pose, state.x) for T in changed)
    )
    numeric = numeric.reshape(-1, 3)[face.flesh.free].ravel()
    exact = response.free_motion(weights, change)
    assert np.abs(numeric).max() > 1e-2
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())
    residual = rng.standard_normal(len(exact))
    adjoint = response.free_adjoint(weights, residual)
    assert np.abs(adjoint).max() > 1e-3
    assert adjoint @ change == pytest.approx(residual @ exact, rel=1e-10)
