"""Small bounded problems and eigenvalues within compiled loops, against SciPy and NumPy."""

import numpy as np
from scipy.optimize import lsq_linear

from solver.mechanics.bounded import solve_bounded
from solver.mechanics.linalg3 import symmetric_eigen


def test_the_bounded_answer_is_the_best_whatever_the_guess():
    random = np.random.default_rng(1)
    most = 0
    for _ in range(40):
        left = random.standard_normal((27, 72)) * random.uniform(0.1, 30.0, 72)
        right = 30.0 * random.standard_normal(27)
        low = random.uniform(0.0, 0.1, 72)
        high = low + random.uniform(0.0, 0.9, 72)
        H = left.T @ left + np.eye(72)
        g = left.T @ right
        x = np.empty(72)
        side = random.integers(0, 3, 72).astype(np.int8)
        assert solve_bounded(H, g, low, high, side, x) > 0
        both = np.vstack([left, np.eye(72)]), np.concatenate([right, np.zeros(72)])
        theirs = lsq_linear(*both, (low, high), method="bvls", tol=1e-15).x
        np.testing.assert_allclose(x, theirs, atol=1e-6)
        again = x.copy()
        most = max(most, solve_bounded(H, g, low, high, side, again))
        np.testing.assert_array_equal(again, x)
    assert most == 1  # the last answer's guess is right at once


def test_symmetric_matrices_have_their_values_and_axes():
    """Any, indefinite, nearly a multiple of the identity, and such with opposite values."""
    random = np.random.default_rng(3)
    some = random.normal(size=(200, 3, 3))
    cases = [*(some + some.transpose(0, 2, 1)), np.diag([1.0, -1.0, 0.5]), np.zeros((3, 3))]
    cases += [np.eye(3) + 1e-13 * each for each in cases[:20]]
    for matrix in cases:
        values = np.empty(3)
        axes = np.empty((3, 3))
        symmetric_eigen(matrix.copy(), values, axes)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-13)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose((axes * values) @ axes.T, matrix, atol=1e-13)
