"""Projection onto the simplex against its optimality conditions."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp

from solver.fitting import simplex
from solver.fitting.simplex import mix_by_stiffness


def test_projection_is_nearest_and_tangents_sum_to_zero():
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 6, size=200)
    indptr = np.concatenate([[0], np.cumsum(lengths)])
    values = rng.standard_normal(indptr[-1])
    nearest = simplex.project(values, indptr)
    gradient = rng.standard_normal(indptr[-1])
    free = simplex.free_entries(nearest, gradient, indptr)
    step = simplex.tangent(-gradient, free, indptr)
    for first, last in pairwise(indptr):
        row = nearest[first:last]
        assert row.min() >= 0.0
        assert abs(row.sum() - 1.0) < 1e-12
        # what was taken off is the same for every entry that stays positive, and less elsewhere
        taken = values[first:last] - row
        assert np.ptp(taken[row > 0]) < 1e-12
        assert (taken <= taken[row > 0].max() + 1e-12).all()
        assert abs(step[first:last].sum()) < 1e-12
        assert (row + 1e-9 * step[first:last] >= -1e-15).all()
    assert step @ gradient < 0.0


def test_parts_of_a_tet_act_as_one_by_their_stiffness():
    """The energies of a tet's parts are, but for a constant, that of their mean shape."""
    fractions = sp.csr_array([[0.9, 0.1, 0.0], [0.5, 0.2, 0.3], [1.0, 0.0, 0.0]])
    S = mix_by_stiffness(fractions, 9.0)
    np.testing.assert_allclose(S.toarray()[0], [0.5, 0.5, 0.0])
    np.testing.assert_allclose(S.sum(axis=1), 1.0)
    assert mix_by_stiffness(fractions, 1.0).toarray() == pytest.approx(fractions.toarray())
    rng = np.random.default_rng(0)
    shapes, (one, other) = rng.normal(size=(3, 6)), rng.normal(size=(2, 6))
    parts = np.array([0.5, 9.0 * 0.2, 9.0 * 0.3])
    mean = (S @ shapes)[1]

    def whole(F):
        return 0.5 * parts.sum() * np.sum((F - mean) ** 2)

    def by_parts(F):
        return 0.5 * parts @ np.sum((F - shapes) ** 2, axis=1)

    assert abs(whole(one) - whole(other)) > 0.1
    assert whole(one) - whole(other) == pytest.approx(by_parts(one) - by_parts(other))
