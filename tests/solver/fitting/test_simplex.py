"""Projection onto the simplex against its optimality conditions."""

from itertools import pairwise

import numpy as np

from solver.fitting import simplex


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
