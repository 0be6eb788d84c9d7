"""Contractions along fibres, fitted to a skin that others made."""

import numpy as np
import pytest

from solver.fitting.face import Face, Pose
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics import equilibrium
from solver.simulation.fibres import (
    ContractionLimits,
    activation_rates,
    contracting,
    driven_by_fibres,
    fibre_activations,
    fit_contractions,
)
from tests.solver.simulation.test_fibres import fibred_block

GAMMA, JAW = np.array([0.75, 1.15]), np.array([0.05, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def face():
    return Face(fibred_block())


def skin(face, gamma, jaw):
    x = face.model.rest.copy()
    x[face.flesh.held] = face.held_positions(jaw)
    A = fibre_activations(face.model, face.model.weights, gamma)
    return face.face_points(equilibrium.solve_equilibrium(face.flesh, face.linear, x, A).x)


def test_rates_are_those_of_the_activations(face):
    step = 1e-6
    exact = activation_rates(face.model, face.model.weights, GAMMA).toarray()
    for muscle in (0, 1):
        rates = exact[:, muscle].reshape(-1, 6)
        change = np.eye(2)[muscle] * step
        ends = [
            fibre_activations(face.model, face.model.weights, GAMMA + sign * change)
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(rates, expected, atol=1e-8)
        assert np.abs(rates).max() > 0.1


def test_contractions_drive_the_flesh_as_their_activations_do(face):
    """The term's energy, forces and Hessian are those of the law with fibre_activations."""
    flesh = driven_by_fibres(face)
    rng = np.random.default_rng(9)
    x = face.model.rest + 0.3 * rng.standard_normal(face.model.rest.shape)
    A = fibre_activations(face.model, face.S, GAMMA)
    assert flesh.energy(x, GAMMA) == face.flesh.energy(x, A) > 1.0
    np.testing.assert_array_equal(flesh.gradient(x, GAMMA), face.flesh.gradient(x, A))
    mine, theirs = flesh.hessian(x, GAMMA, project=0.4), face.flesh.hessian(x, A, project=0.4)
    np.testing.assert_array_equal(mine.data, theirs.data)
    exact, step = flesh.forces_by_control(x, GAMMA).toarray(), 1e-6
    for muscle in (0, 1):
        change = step * np.eye(2)[muscle]
        ends = [flesh.gradient(x, GAMMA + sign * change) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert np.abs(expected).max() > 1.0
        np.testing.assert_allclose(exact[:, muscle], expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_array_equal(flesh.passive(), [1.0, 1.0])


def test_the_jacobian_is_that_of_the_equilibrium(face):
    driven = contracting(face)
    theta = np.concatenate([GAMMA, JAW])
    state = driven.continuation(driven.rest, Pose.of(driven.layout, theta))
    motions = Sensitivity(driven, state).by_pose()
    points = np.zeros((face.model.rest.size, len(theta)))
    points[motions.free] = motions.flesh
    points += motions.held.toarray()
    jacobian = face.face_embedding @ points.reshape(len(face.model.rest), -1)
    jacobian = jacobian.reshape(-1, len(theta))
    step = 1e-4
    for k in (0, 1, 2, 6):
        change = step * np.eye(len(theta))[k]
        poses = [Pose.of(driven.layout, theta + sign * change) for sign in (1, -1)]
        ends = [face.face_points(driven.solve_equilibrium(pose, state.x).x) for pose in poses]
        expected = (ends[0] - ends[1]).ravel() / (2 * step)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(jacobian[:, k], expected, atol=2e-3 * np.abs(expected).max())


def test_contractions_and_jaw_are_found(face):
    target = skin(face, GAMMA, JAW)
    moved = np.linalg.norm(target - face.face_points(face.model.rest), axis=1).mean()
    found = fit_contractions(face, target).state
    left = np.linalg.norm(face.face_points(found.x) - target, axis=1).mean()
    assert left < 0.03 * moved
    np.testing.assert_allclose(found.pose.a, GAMMA, atol=0.05)


def test_limits_of_contractions_hold_exactly(face):
    limits = ContractionLimits(least=0.85, most=1.1)
    found = fit_contractions(face, skin(face, GAMMA, JAW), limits).state
    np.testing.assert_array_equal(found.pose.a, [0.85, 1.1])
