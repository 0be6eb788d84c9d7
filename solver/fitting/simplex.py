"""The set S lives on: every row on the unit simplex over its candidate columns.

Rows are those of a CSR matrix given by its ``indptr``; values are its data (nnz,).
"""

from __future__ import annotations

from collections.abc import Callable

import numba as nb
import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from solver.surface import Floats, Ints

PASSES = 3
ITERATIONS = 10
TOLERANCE = 0.1
HALVINGS = 4


def minimise(
    values: Floats,
    gradient: Floats,
    product: Callable[[Floats], Floats],
    indptr: Ints,
    reach: float,
) -> Floats:
    """Return the values that minimise g . d + 1/2 d . H d on the simplex, d their change.

    ``gradient`` (nnz,) is g at ``values``, ``product`` multiplies by the positive definite H; no
    value moves by more than ``reach``. A few passes of conjugate gradients, each on the face that
    the last one ended on and projected afterwards (More and Toraldo 1991), not to convergence.
    """
    at, slope = values, gradient
    for _ in range(PASSES):
        free = free_entries(at, slope, indptr)

        def on_face(direction: Floats, free: NDArray[np.bool_] = free) -> Floats:
            return tangent(product(direction), free, indptr)

        system = scipy.sparse.linalg.LinearOperator(
            (len(values), len(values)), matvec=on_face, dtype=np.float64
        )
        right = -tangent(slope, free, indptr)
        step, _ = scipy.sparse.linalg.cg(system, right, rtol=TOLERANCE, maxiter=ITERATIONS)
        for halving in range(HALVINGS):
            goal = np.clip(at + 0.5**halving * step, values - reach, values + reach)
            move = project(goal, indptr) - at
            image = product(move)
            if slope @ move + 0.5 * move @ image < 0.0:
                break
        else:
            break
        at, slope = at + move, slope + image
    return at


@nb.njit(cache=True, parallel=True)
def project(values: Floats, indptr: Ints) -> Floats:
    """Return the nearest values with s >= 0 and sum 1 in every row (Held, Wolfe, Crowder 1974)."""
    out = np.empty_like(values)
    for row in nb.prange(len(indptr) - 1):
        first, last = indptr[row], indptr[row + 1]
        descending = np.sort(values[first:last])[::-1]
        total, threshold = 0.0, 0.0
        for k in range(last - first):
            total += descending[k]
            shift = (total - 1.0) / (k + 1)
            if descending[k] <= shift:
                break
            threshold = shift
        for entry in range(first, last):
            out[entry] = max(values[entry] - threshold, 0.0)
    return out


@nb.njit(cache=True, parallel=True)
def free_entries(values: Floats, gradient: Floats, indptr: Ints) -> NDArray[np.bool_]:
    """Tell which entries may move: not those at zero that the gradient pushes below it.

    The push is the gradient less its mean over the row's free entries, the multiplier of the sum.
    """
    free = np.ones(len(values), dtype=np.bool_)
    for row in nb.prange(len(indptr) - 1):
        first, last = indptr[row], indptr[row + 1]
        changed = True
        while changed:
            changed = False
            total, count = 0.0, 0
            for entry in range(first, last):
                if free[entry]:
                    total += gradient[entry]
                    count += 1
            for entry in range(first, last):
                held = values[entry] <= 0.0 and gradient[entry] * count > total
                if free[entry] and held and count > 1:
                    free[entry] = False
                    changed = True
    return free


@nb.njit(cache=True, parallel=True)
def tangent(values: Floats, free: NDArray[np.bool_], indptr: Ints) -> Floats:
    """Project onto the face's tangent: zero at entries that are not free, rows that sum to zero."""
    out = np.zeros_like(values)
    for row in nb.prange(len(indptr) - 1):
        total, count = 0.0, 0
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                total += values[entry]
                count += 1
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                out[entry] = values[entry] - total / count
    return out
