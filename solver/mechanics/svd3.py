"""Signed singular value decomposition of 3x3 matrices, for kernels.

G = U diag(s) V^T with U and V rotations; the smallest singular value carries the sign of det G, so
that U V^T is the rotation nearest to G also for inverted elements.
"""

from __future__ import annotations

import math

import numba as nb

from solver.surface import Floats

SWEEPS = 12
"""One-sided Jacobi converges quadratically: five sweeps are usual, twelve never reached."""

PAIRS = ((0, 1), (0, 2), (1, 2))


@nb.njit(cache=True, error_model="numpy")
def signed_svd(G: Floats, U: Floats, s: Floats, V: Floats) -> None:
    """Decompose ``G`` (3, 3) into ``U`` (3, 3), ``s`` (3,) and ``V`` (3, 3), in place.

    One-sided Jacobi rotations (Hestenes 1958): accurate also for small singular values, where an
    eigen-decomposition of G^T G would lose half of the digits.
    """
    for i in range(3):
        for j in range(3):
            U[i, j] = G[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        rotated = False
        for p, q in PAIRS:
            alpha = U[0, p] * U[0, p] + U[1, p] * U[1, p] + U[2, p] * U[2, p]
            beta = U[0, q] * U[0, q] + U[1, q] * U[1, q] + U[2, q] * U[2, q]
            gamma = U[0, p] * U[0, q] + U[1, p] * U[1, q] + U[2, p] * U[2, q]
            if abs(gamma) <= 1e-16 * math.sqrt(alpha * beta):
                continue
            rotated = True
            zeta = (beta - alpha) / (2.0 * gamma)
            t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
            c = 1.0 / math.sqrt(1.0 + t * t)
            w = c * t
            for i in range(3):
                up = U[i, p]
                U[i, p] = c * up - w * U[i, q]
                U[i, q] = w * up + c * U[i, q]
                vp = V[i, p]
                V[i, p] = c * vp - w * V[i, q]
                V[i, q] = w * vp + c * V[i, q]
        if not rotated:
            break
    small = 0
    for k in range(3):
        s[k] = math.sqrt(U[0, k] * U[0, k] + U[1, k] * U[1, k] + U[2, k] * U[2, k])
        if s[k] < s[small]:
            small = k
    i, j, k = (small + 1) % 3, (small + 2) % 3, small
    b0, b1, b2 = U[0, k], U[1, k], U[2, k]
    for column in (i, j):
        scale = 1.0 / s[column] if s[column] > 0.0 else 0.0
        for row in range(3):
            U[row, column] *= scale
    U[0, k] = U[1, i] * U[2, j] - U[2, i] * U[1, j]
    U[1, k] = U[2, i] * U[0, j] - U[0, i] * U[2, j]
    U[2, k] = U[0, i] * U[1, j] - U[1, i] * U[0, j]
    s[k] = U[0, k] * b0 + U[1, k] * b1 + U[2, k] * b2
