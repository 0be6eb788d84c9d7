"""Vertices that slide: derivatives, and a slide along a tilted plane."""

import numpy as np
import pytest

from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import Flesh
from solver.mechanics.terms import planes
from tests.solver.block import grid

TILTED = np.array([0.0, 0.6, 0.8])


def sliding_block():
    """A block held on its left side whose back slides on tilted planes."""
    vertices, tets = grid((4, 3, 2), (20.0, 15.0, 10.0))
    held = np.flatnonzero(vertices[:, 0] == 0.0)
    back = np.setdiff1d(np.flatnonzero(vertices[:, 2] == 0.0), held)
    normals = np.tile(TILTED, (len(back), 1))
    return Flesh(vertices, tets, held, sliding=planes(vertices, tets, back, normals, 1.0))


def test_derivatives_match_finite_differences():
    flesh = sliding_block()
    rng = np.random.default_rng(4)
    direction = rng.standard_normal((len(flesh.free), 3))
    x = flesh.rest.copy()
    x[flesh.free] += 0.3 * rng.standard_normal(direction.shape)
    a = flesh.passive()
    h = 1e-6
    ends = []
    for sign in (1, -1):
        y = x.copy()
        y[flesh.free] += sign * h * direction
        ends.append((flesh.energy(y, a), flesh.gradient(y, a)))
    slope = (ends[0][0] - ends[1][0]) / (2 * h)
    change = (ends[0][1] - ends[1][1]) / (2 * h)
    without = Flesh(flesh.rest, flesh.tets, np.flatnonzero(flesh.free_numbers < 0))
    assert flesh.energy(x, a) > 10.0 * without.energy(x, a)
    assert flesh.gradient(x, a) @ direction.ravel() == pytest.approx(slope, rel=1e-6)
    H = flesh.hessian(x, a)
    np.testing.assert_allclose(H @ direction.ravel(), change, atol=1e-6 * np.abs(change).max())
    assert abs(H - H.T).max() < 1e-10 * abs(H).max()


def test_contracting_flesh_slides_in_its_plane():
    flesh = sliding_block()
    a = np.tile([0.7, 0.0, 0.0, 1.2, 0.0, 1.2], (len(flesh.tets), 1))
    solver = linear.analyse(flesh.hessian(flesh.rest, flesh.passive()))
    x = equilibrium.solve_equilibrium(flesh, solver, flesh.rest, a).x
    back = flesh.sliding.vertices[:, 0]
    moved = np.linalg.norm(x[back] - flesh.rest[back], axis=1)
    assert moved.max() > 4.0
    assert np.abs(flesh.sliding.drift(x)).max() < 0.01
