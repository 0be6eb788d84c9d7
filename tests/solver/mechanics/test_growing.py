"""Matrices with changing extra entries: the right answers, and few analyses."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.mechanics.linear import GrowingSolver

SIZE = 30


def spring(i, j, stiffness=1.0):
    """Return the 3x3-block spring between vertices i and j."""
    direction = np.zeros(SIZE)
    direction[3 * i : 3 * i + 3] = [0.6, 0.8, 0.0]
    direction[3 * j : 3 * j + 3] = [-0.6, -0.8, 0.0]
    return sp.csr_array(stiffness * np.outer(direction, direction))


@pytest.fixture
def base():
    chain = sum((spring(k, k + 1) for k in range(9)), sp.csr_array((SIZE, SIZE)))
    base = sp.csr_array(chain + sp.eye_array(SIZE))
    base.sort_indices()
    return base


def test_sums_are_solved_and_patterns_that_were_seen_not_analysed_again(base):
    solver = GrowingSolver(base, "superlu")
    b = np.arange(SIZE, dtype=float)
    extras = [spring(0, 5), spring(0, 5, 2.0), spring(0, 1, 3.0), sp.csr_array((SIZE, SIZE))]
    for extra in extras:
        x = solver.plus(extra).factor(base.data).solve(b)
        np.testing.assert_allclose((base + extra) @ x, b, atol=1e-10)
    assert solver.analyses == 2


def test_patterns_of_long_ago_are_forgotten(base):
    """Contact that wanders over the face leaves no ever growing matrix behind."""
    solver = GrowingSolver(base, "superlu")
    for i in range(10):
        for j in range(i + 2, 10):
            solver.plus(spring(i, j)).factor(base.data)
    assert len(solver.known) <= 1.5 * base.nnz
