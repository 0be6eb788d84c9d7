"""Lagged sensitivities: what they learn from steps, against the matrices written out."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp

from solver.fitting.sensitivity import Jacobian
from solver.fitting.tracking.lagged import LaggedModel, SecantOptions

VERTICES = 6
CONTROLS = 5
FREE = np.arange(3, 3 * VERTICES)  # the first vertex is held


@dataclass(frozen=True)
class Quadratic:
    """A term whose curvature is C everywhere."""

    matrix: sp.csr_array

    def curvature(self, _x):
        return self.matrix


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def parts(rng):
    root = sp.random_array((3 * VERTICES, 3 * VERTICES), density=0.4, rng=rng)
    curvature = sp.csr_array(root.T @ root + sp.eye_array(3 * VERTICES))
    held = sp.csr_array((3 * VERTICES, CONTROLS))
    return Jacobian(rng.normal(size=(len(FREE), CONTROLS)), held, FREE), Quadratic(curvature)


def lagged(parts, **options):
    jacobian, data = parts
    x = np.zeros((VERTICES, 3))
    return LaggedModel(jacobian, data, np.ones(VERTICES), x, SecantOptions(**options))


def as_matrix(model):
    """Return J (size, k), column by column, and its transpose by the adjoint."""
    ahead = np.array([model.flesh_motion(each) for each in np.eye(CONTROLS)]).T
    places = np.eye(3 * VERTICES)[FREE]
    back = np.array([model.adjoint(each.reshape(-1, 3)) for each in places])
    return ahead, back


def test_a_step_that_was_learned_is_foreseen(parts, rng):
    model = lagged(parts)
    change = rng.normal(size=CONTROLS)
    other = rng.normal(size=CONTROLS)
    other -= other @ model.hessian @ change / (change @ model.hessian @ change) * change
    moved = model.flesh_motion(change) + 0.2 * rng.normal(size=len(FREE))
    before = model.flesh_motion(other)
    model.learn(change, moved - model.flesh_motion(change))
    np.testing.assert_allclose(model.flesh_motion(change), moved, atol=1e-9)
    # what H takes to be another way stays as it was
    np.testing.assert_allclose(model.flesh_motion(other), before, atol=1e-9)


@pytest.mark.parametrize("most", [2, 40])
def test_the_matrices_stay_those_of_one_jacobian(parts, rng, most):
    model = lagged(parts, most=most)
    matrix = parts[1].matrix.toarray()[np.ix_(FREE, FREE)]
    plain = as_matrix(model)[0]
    for _ in range(5):
        model.learn(rng.normal(size=CONTROLS), 0.3 * rng.normal(size=len(FREE)))
    ahead, back = as_matrix(model)
    assert np.abs(ahead - plain).max() > 0.1
    # updates that were added lie in single precision
    np.testing.assert_allclose(ahead, back, atol=1e-5)
    np.testing.assert_allclose(model.hessian, ahead.T @ matrix @ ahead, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("size", [1e-4, 100.0])
def test_a_step_that_was_foreseen_or_that_buckled_the_flesh_tells_nothing(parts, rng, size):
    model = lagged(parts)
    before = model.hessian.copy()
    model.learn(rng.normal(size=CONTROLS), size * rng.normal(size=len(FREE)))
    np.testing.assert_array_equal(model.hessian, before)
