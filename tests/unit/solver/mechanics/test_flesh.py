"""The mesh-wide energy against finite differences, a linear patch and a known answer."""

import numpy as np
import pytest

from solver.errors import InputError, SolveError
from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import Flesh
from tests.unit.solver.block import block_model, grid


@pytest.fixture(scope="module")
def strained():
    """Flesh far from rest: random activations that commute with nothing, a few tets nearly flat."""
    model = block_model()
    flesh = Flesh(model.rest, model.tets, model.cranium)
    rng = np.random.default_rng(5)
    x = model.rest.copy()
    x[flesh.free] += 1.2 * rng.standard_normal((len(flesh.free), 3))
    a = flesh.passive() + 0.3 * rng.standard_normal((len(model.tets), 6))
    assert flesh.openings(x).min() < 0.35
    assert np.isfinite(flesh.energy(x, a))
    return flesh, x, a, rng.standard_normal((len(flesh.free), 3))


def moved(flesh, x, direction, step):
    y = x.copy()
    y[flesh.free] += step * direction
    return y


def test_gradient_matches_finite_differences(strained):
    flesh, x, a, direction = strained
    h = 1e-6
    ends = [flesh.energy(moved(flesh, x, direction, sign * h), a) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * h)
    assert abs(numeric) > 1.0
    assert flesh.gradient(x, a) @ direction.ravel() == pytest.approx(numeric, rel=1e-6)


def test_hessian_matches_finite_differences_and_is_symmetric(strained):
    flesh, x, a, direction = strained
    h = 1e-6
    ends = [flesh.gradient(moved(flesh, x, direction, sign * h), a) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * h)
    H = flesh.hessian(x, a)
    assert np.abs(numeric).max() > 1.0
    np.testing.assert_allclose(H @ direction.ravel(), numeric, atol=1e-6 * np.abs(numeric).max())
    assert abs(H - H.T).max() < 1e-10 * abs(H).max()


def test_linear_displacements_are_solved_exactly():
    """The patch test: held at a linear displacement on the boundary, the inside follows it."""
    vertices, tets = grid((4, 4, 4), (20.0, 20.0, 20.0))
    outside = ((vertices == 0.0) | (vertices == 20.0)).any(axis=1)
    flesh = Flesh(vertices, tets, np.flatnonzero(outside))
    F = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.1], [0.0, 0.2, 1.05]])
    x = vertices @ F.T
    start = x.copy()
    start[flesh.free] += 0.3 * np.random.default_rng(2).standard_normal((len(flesh.free), 3))
    a = flesh.passive()
    solver = linear.analyse(flesh.hessian(vertices, a))
    result = equilibrium.solve(flesh, solver, start, a)
    np.testing.assert_allclose(result.x, x, atol=1e-7)


def test_free_flesh_takes_the_shape_of_its_activation():
    """Three held corners leave a uniformly active block free to become S(a): zero energy left."""
    vertices, tets = grid((3, 3, 3), (15.0, 15.0, 15.0))
    stretch = np.diag([0.8, 1.1, 1.15])
    from solver.mechanics.flesh import Material

    held = np.flatnonzero((vertices == 0.0).all(axis=1))
    corner = np.flatnonzero((vertices == [15.0, 0.0, 0.0]).all(axis=1))
    third = np.flatnonzero((vertices == [0.0, 15.0, 0.0]).all(axis=1))
    held = np.concatenate([held, corner, third])
    flesh = Flesh(vertices, tets, held, Material(lam=0.0))
    start = vertices.copy()
    start[held] = vertices[held] @ stretch
    a = np.tile(stretch[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], (len(tets), 1))
    solver = linear.analyse(flesh.hessian(vertices, a))
    result = equilibrium.solve(flesh, solver, start, a)
    np.testing.assert_allclose(result.x, vertices @ stretch, atol=1e-6)
    assert result.minimum


def test_newton_converges_quadratically():
    model = block_model()
    flesh = Flesh(model.rest, model.tets, np.concatenate([model.cranium, model.mandible]))
    rng = np.random.default_rng(0)
    a = flesh.passive() + 0.15 * rng.standard_normal((len(model.tets), 6))
    solver = linear.analyse(flesh.hessian(model.rest, a))
    result = equilibrium.solve(flesh, solver, model.rest, a, tolerance=1e-12)
    assert result.residual <= 1e-12
    assert result.iterations <= 8


def test_inverted_starts_and_meshes_are_named():
    vertices, tets = grid((2, 2, 2), (10.0, 10.0, 10.0))
    wrong = tets.copy()
    wrong[5] = wrong[5][[1, 0, 2, 3]]
    with pytest.raises(InputError, match="number 5"):
        Flesh(vertices, wrong, np.array([0]))
    flesh = Flesh(vertices, tets, np.array([0]))
    solver = linear.analyse(flesh.hessian(vertices, flesh.passive()))
    with pytest.raises(SolveError) as caught:
        equilibrium.solve(flesh, solver, vertices * [1.0, 1.0, -1.0], flesh.passive())
    assert caught.value.code == "solve.inverted"
