"""Contractions along fibres, fitted to a skin that others made."""

import numpy as np
import pytest

from solver.fitting.drives.fibre_contraction import (
    ContractionLimits,
    FibreContraction,
    activation_rates,
    fibre_activations,
    fit_contractions,
)
from solver.fitting.face import Face, Pose
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics import equilibrium
from tests.solver.simulation.test_fibres import fibred_block

GAMMA = np.array([0.75, 1.15])
JAW = np.array([0.05, 0.0, 0.0, 0.0, 0.0])


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


def test_the_jacobian_is_that_of_the_equilibrium(face):
    driven = face.driven_by(FibreContraction(face.model))
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
