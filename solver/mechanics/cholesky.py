"""Small systems by Cholesky's factors, within compiled loops."""

from __future__ import annotations

import math

import numba as nb

from solver.surface import Floats


@nb.njit(cache=True, error_model="numpy")
def solve_lower(A: Floats, b: Floats) -> None:
    """Solve A x = b in place by Cholesky's factors; of ``A`` (n, n) the lower half is read."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = math.sqrt(s) if i == j else s / A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
