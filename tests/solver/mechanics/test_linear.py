"""Linear solvers give the dense answer, keep factors apart and find an indefinite matrix."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.errors import InputError
from solver.mechanics import linear


def laplacian_block(side=6):
    """A vector-valued grid Laplacian with coupled coordinates, symmetric positive definite."""
    line = sp.diags_array(
        [2.0 * np.ones(side), -np.ones(side - 1), -np.ones(side - 1)], offsets=[0, 1, -1]
    )
    eye = sp.eye_array(side)
    grid = sp.kron(sp.kron(line, eye), eye) + sp.kron(sp.kron(eye, line), eye)
    grid = grid + sp.kron(sp.kron(eye, eye), line)
    coupled = sp.csr_array(sp.kron(grid, np.eye(3) + 0.2))
    coupled.sort_indices()
    return coupled


@pytest.mark.parametrize("name", list(linear.SOLVERS))
def test_solves_and_rejects(name):
    pytest.importorskip(linear.SOLVERS[name][0])
    K = laplacian_block()
    solver = linear.analyse(K, name)
    B = np.random.default_rng(0).standard_normal((K.shape[0], 7))
    first = solver.factor(K.data)
    second = solver.factor(3.0 * K.data)
    expected = np.linalg.solve(K.toarray(), B)
    error = 1e-5 if name == "rslab-single" else 1e-10
    np.testing.assert_allclose(first.solve(B), expected, atol=error)
    np.testing.assert_allclose(first.solve(B[:, 0]), expected[:, 0], atol=error)
    np.testing.assert_allclose(second.solve(B), expected / 3.0, atol=error)
    rows = np.repeat(np.arange(K.shape[0]), np.diff(K.indptr))
    indefinite = K.data.copy()
    indefinite[(rows == 40) & (K.indices == 40)] = -5.0
    with pytest.raises(linear.NotPositiveDefiniteError):
        solver.factor(indefinite)


def test_unknown_solver_is_named():
    with pytest.raises(InputError, match="magic"):
        linear.analyse(laplacian_block(2), "magic")
