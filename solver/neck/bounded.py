"""Bounded least squares, exactly: min x . H x / 2 - g . x with low <= x <= high, H positive.

Block principal pivoting (Portugal, Judice, Vicente 1994): guess which x are at a bound, solve for
the others, and exchange all that are wrong. Where that stops to help, they are exchanged one by
one, the last first, which always ends (Murty 1974). The guess is the last answer's.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from solver.surface import Floats

FREE, LOW, HIGH = 0, 1, 2
PATIENCE = 5  # exchanges of all that are wrong, without fewer of them
TOLERANCE = 1e-9  # of x, and of the gradient by the greatest of H's diagonal
MOST = 2000  # exchanges


@nb.njit(cache=True, error_model="numpy")
def solve_bounded(
    H: Floats, g: Floats, low: Floats, high: Floats, side: np.ndarray, x: Floats
) -> int:
    """Write the answer to ``x`` (n,) and where each is to ``side`` (n,), which holds the guess.

    Returns the number of systems that were solved, 0 if it did not end.
    """
    n = len(g)
    scale = 0.0
    for i in range(n):
        scale = max(scale, H[i, i])
    best, patience = n + 1, PATIENCE
    for count in range(1, MOST):
        _solve_free(H, g, low, high, side, x)
        wrong, last = 0, -1
        to = np.empty(n, np.int8)
        for i in range(n):
            to[i] = side[i]
            if side[i] == FREE:
                if x[i] < low[i] - TOLERANCE:
                    to[i] = LOW
                elif x[i] > high[i] + TOLERANCE:
                    to[i] = HIGH
            else:
                rise = -g[i]
                for j in range(n):
                    rise += H[i, j] * x[j]
                inward = -rise if side[i] == LOW else rise
                if inward > TOLERANCE * scale:
                    to[i] = FREE
            if to[i] != side[i]:
                wrong, last = wrong + 1, i
        if wrong == 0:
            for i in range(n):
                x[i] = min(max(x[i], low[i]), high[i])
            return count
        if wrong < best:
            best, patience = wrong, PATIENCE
        else:
            patience -= 1
        if patience > 0:
            side[:] = to
        else:
            side[last] = to[last]
    return 0


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
    L, b = np.empty((count, count)), np.empty(count)
    for r in range(count):
        i = free[r]
        b[r] = g[i]
        for j in range(n):
            if side[j] != FREE:
                b[r] -= H[i, j] * x[j]
        for c in range(r + 1):
            s = H[i, free[c]]
            for k in range(c):
                s -= L[r, k] * L[c, k]
            L[r, c] = math.sqrt(s) if r == c else s / L[c, c]
        for k in range(r):
            b[r] -= L[r, k] * b[k]
        b[r] /= L[r, r]
    for r in range(count - 1, -1, -1):
        for k in range(r + 1, count):
            b[r] -= L[k, r] * b[k]
        b[r] /= L[r, r]
        x[free[r]] = b[r]
