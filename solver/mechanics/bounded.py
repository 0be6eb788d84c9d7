"""Bounded least squares, exactly: min x . H x / 2 - g . x with low <= x <= high, H positive.

Block principal pivoting (Portugal, Judice, Vicente 1994): guess which x are at a bound, solve for
the others, and exchange all that are wrong; the guess is the last answer's. Where that stops to
help, an active set goes on from there, feasible at every step (Stark and Parker 1995): towards the
answer for those that are free up to the first bound, and one that should leave its bound at a time.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from solver.mechanics.cholesky import solve_lower
from solver.surface import Floats

# The side that an x is on
FREE = 0  # between its bounds, and solved for
LOW = 1  # at its lower bound
HIGH = 2  # at its upper one
PATIENCE = 3  # exchanges of all that are wrong, without fewer of them
TOLERANCE = 1e-9  # of x, and of a gradient by its entry of H's diagonal
MOST = 2000  # systems


@nb.njit(cache=True, error_model="numpy")
def solve_bounded(
    H: Floats, g: Floats, low: Floats, high: Floats, side: np.ndarray, x: Floats
) -> int:
    """Write the answer to ``x`` (n,) and where each is to ``side`` (n,), which holds the guess.

    Returns the number of systems that were solved, 0 if it did not end.
    """
    n = len(g)
    best = n + 1
    patience = PATIENCE
    count = 0
    to = np.empty(n, np.int8)
    while patience > 0:
        _solve_free(H, g, low, high, side, x)
        count += 1
        wrong = 0
        for i in range(n):
            to[i] = side[i]
            if side[i] == FREE:
                if x[i] < low[i] - TOLERANCE:
                    to[i] = LOW
                elif x[i] > high[i] + TOLERANCE:
                    to[i] = HIGH
            elif _inward(H, g, x, side, i) > TOLERANCE:
                to[i] = FREE
            wrong += to[i] != side[i]
        if wrong == 0:
            return count
        if wrong < best:
            best = wrong
            patience = PATIENCE
        else:
            patience -= 1
        side[:] = to
    return _go_on(H, g, low, high, side, x, count)


@nb.njit(cache=True, error_model="numpy")
def _go_on(
    H: Floats, g: Floats, low: Floats, high: Floats, side: np.ndarray, x: Floats, count: int
) -> int:
    n = len(g)
    z = np.empty(n)
    for i in range(n):
        x[i] = low[i] if side[i] == LOW else high[i] if side[i] == HIGH else x[i]
        x[i] = min(max(x[i], low[i]), high[i])
    while count < MOST:
        _solve_free(H, g, low, high, side, z)
        count += 1
        step = 1.0
        first = -1
        for i in range(n):
            if side[i] == FREE and not low[i] <= z[i] <= high[i]:
                bound = low[i] if z[i] < low[i] else high[i]
                part = (bound - x[i]) / (z[i] - x[i])
                if part < step:
                    step = part
                    first = i
        for i in range(n):
            x[i] += step * (z[i] - x[i])
        if first >= 0:
            side[first] = LOW if z[first] < low[first] else HIGH
            x[first] = low[first] if side[first] == LOW else high[first]
            continue
        most = TOLERANCE
        worst = -1
        for i in range(n):
            if side[i] != FREE:
                inward = _inward(H, g, x, side, i)
                if inward > most:
                    most = inward
                    worst = i
        if worst < 0:
            return count
        side[worst] = FREE
    return 0


@nb.njit(cache=True, error_model="numpy")
def _inward(H: Floats, g: Floats, x: Floats, side: np.ndarray, i: int) -> float:
    """Return how much what is minimised falls as x_i leaves its bound, by H_ii."""
    rise = -g[i]
    for j in range(len(g)):
        rise += H[i, j] * x[j]
    inward: float = (-rise if side[i] == LOW else rise) / H[i, i]
    return inward


@nb.njit(cache=True, error_model="numpy")
def _solve_free(
    H: Floats, g: Floats, low: Floats, high: Floats, side: np.ndarray, x: Floats
) -> None:
    n = len(g)
    free = np.empty(n, np.int64)
    count = 0
    for i in range(n):
        if side[i] == FREE:
            free[count] = i
            count += 1
        else:
            x[i] = low[i] if side[i] == LOW else high[i]
    A = np.empty((count, count))
    b = np.empty(count)
    for r in range(count):
        i = free[r]
        b[r] = g[i]
        for j in range(n):
            if side[j] != FREE:
                b[r] -= H[i, j] * x[j]
        for c in range(r + 1):
            A[r, c] = H[i, free[c]]
    solve_lower(A, b)
    for r in range(count):
        x[free[r]] = b[r]
