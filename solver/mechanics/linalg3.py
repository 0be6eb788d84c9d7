"""Algebra of 3x3 matrices for kernels: cofactors, singular values, polar decomposition G = R P.

The polar decomposition needs no singular vectors. The sum t = s1 + s2 + s3 of the singular values
(the smallest with the sign of det G) is the largest root of

    (t^2 - I)^2 - 4 II - 8 J t = 0,   I = |G|^2, II = |cof G|^2, J = det G,

since its roots are the four sums +-s1 +-s2 +-s3 with an even number of minus signs. Newton's method
from sqrt(3 I) >= t falls to it monotonically, in two to four steps near rest. The derivatives of t
by G give the rest: the rotation R nearest to G is dt/dG, implicitly differentiated, and turns as

    dR = R [w]x,   Y w = axl(R^T dG - dG^T R),   Y = tr(P) I - P,   det Y = f'(t) / 8.

Matrices are tuples of nine numbers by rows, symmetric ones of six (xx, xy, xz, yy, yz, zz): a
compiler keeps them in registers.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from solver.surface import Floats


@nb.njit(cache=True, error_model="numpy")
def signed_svd(G: Floats, U: Floats, s: Floats, V: Floats) -> None:
    """Decompose ``G`` (3, 3) into ``U`` (3, 3), ``s`` (3,) and ``V`` (3, 3): G = U diag(s) V^T.

    U and V are rotations; the smallest singular value carries the sign of det G, so that U V^T is
    the rotation nearest to G also for inverted elements. One-sided Jacobi rotations (Hestenes
    1958): accurate also for small singular values, where an eigen-decomposition of G^T G would
    lose half of the digits.
    """
    for i in range(3):
        for j in range(3):
            U[i, j] = G[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    # Jacobi converges quadratically: five sweeps are usual, twelve never reached
    for _ in range(12):
        rotated = False
        for p, q in ((0, 1), (0, 2), (1, 2)):
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
    i = (small + 1) % 3
    j = (small + 2) % 3
    k = small
    b0 = U[0, k]
    b1 = U[1, k]
    b2 = U[2, k]
    for column in (i, j):
        scale = 1.0 / s[column] if s[column] > 0.0 else 0.0
        for row in range(3):
            U[row, column] *= scale
    U[0, k] = U[1, i] * U[2, j] - U[2, i] * U[1, j]
    U[1, k] = U[2, i] * U[0, j] - U[0, i] * U[2, j]
    U[2, k] = U[0, i] * U[1, j] - U[1, i] * U[0, j]
    s[k] = U[0, k] * b0 + U[1, k] * b1 + U[2, k] * b2


@nb.njit(cache=True, error_model="numpy")
def symmetric_eigen(A: Floats, values: Floats, axes: Floats) -> None:
    """Decompose a symmetric ``A`` (3, 3) into ``values`` (3,), the least first, and ``axes``.

    These are a matrix's columns. A is overwritten. Jacobi rotations (Golub and Van Loan 2013,
    section 8.5).
    """
    for i in range(3):
        for j in range(3):
            axes[i, j] = 1.0 if i == j else 0.0
    # quadratic, too: four sweeps are usual
    for _ in range(12):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if not off > 1e-16 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            break
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if A[p, q] == 0.0:
                continue
            zeta = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
            t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
            c = 1.0 / math.sqrt(1.0 + t * t)
            w = c * t
            r = 3 - p - q
            rp = c * A[r, p] - w * A[r, q]
            rq = w * A[r, p] + c * A[r, q]
            A[p, p] -= t * A[p, q]
            A[q, q] += t * A[p, q]
            A[p, q] = 0.0
            A[q, p] = 0.0
            A[r, p] = rp
            A[p, r] = rp
            A[r, q] = rq
            A[q, r] = rq
            for i in range(3):
                vp = axes[i, p]
                axes[i, p] = c * vp - w * axes[i, q]
                axes[i, q] = w * vp + c * axes[i, q]
    for i in range(3):
        values[i] = A[i, i]
    for p, q in ((0, 1), (1, 2), (0, 1)):
        if values[p] > values[q]:
            values[p], values[q] = values[q], values[p]
            for i in range(3):
                axes[i, p], axes[i, q] = axes[i, q], axes[i, p]


Matrix = tuple[float, float, float, float, float, float, float, float, float]
Symmetric = tuple[float, float, float, float, float, float]

SYM_ROW = (0, 0, 0, 1, 1, 2)  # Sym(3) in the order xx, xy, xz, yy, yz, zz
SYM_COLUMN = (0, 1, 2, 1, 2, 2)  # of the same

CONVERGED = 1e-9  # last relative step: the error left is of the order of its square
CONDITION = 1e-2  # det Y / (t^3 / 8) below which R is off by 1e-12: singular vectors take over
LEAST_SUM = 1e-8  # of two singular values: R turns by 1 / (s_i + s_j), no faster than this


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def cofactor(G: Matrix) -> Matrix:
    """Return d(det G)/dG."""
    a, b, c, d, e, f, g, h, i = G
    return (
        e * i - f * h,
        f * g - d * i,
        d * h - e * g,
        c * h - b * i,
        a * i - c * g,
        b * g - a * h,
        b * f - c * e,
        c * d - a * f,
        a * e - b * d,
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def dot(X: Matrix, Y: Matrix) -> float:
    """Return <X, Y> = tr(X^T Y)."""
    return (
        (X[0] * Y[0] + X[1] * Y[1] + X[2] * Y[2])
        + (X[3] * Y[3] + X[4] * Y[4] + X[5] * Y[5])
        + (X[6] * Y[6] + X[7] * Y[7] + X[8] * Y[8])
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def determinant(F: Matrix) -> float:
    """Return det F."""
    a, b, c, d, e, f, g, h, i = F
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_cofactor(A: Symmetric) -> Symmetric:
    """Return d(det A)/dA as a symmetric matrix."""
    xx, xy, xz, yy, yz, zz = A
    return (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_determinant(A: Symmetric) -> float:
    """Return det A."""
    C = symmetric_cofactor(A)
    return A[0] * C[0] + A[1] * C[1] + A[2] * C[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def times(F: Matrix, A: Symmetric) -> Matrix:
    """Return F A."""
    return product(F, full(A))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def product(X: Matrix, Y: Matrix) -> Matrix:
    """Return X Y."""
    return (
        X[0] * Y[0] + X[1] * Y[3] + X[2] * Y[6],
        X[0] * Y[1] + X[1] * Y[4] + X[2] * Y[7],
        X[0] * Y[2] + X[1] * Y[5] + X[2] * Y[8],
        X[3] * Y[0] + X[4] * Y[3] + X[5] * Y[6],
        X[3] * Y[1] + X[4] * Y[4] + X[5] * Y[7],
        X[3] * Y[2] + X[4] * Y[5] + X[5] * Y[8],
        X[6] * Y[0] + X[7] * Y[3] + X[8] * Y[6],
        X[6] * Y[1] + X[7] * Y[4] + X[8] * Y[7],
        X[6] * Y[2] + X[7] * Y[5] + X[8] * Y[8],
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_product(X: Matrix, Y: Matrix) -> Symmetric:
    """Return X^T Y, which is symmetric."""
    return (
        X[0] * Y[0] + X[3] * Y[3] + X[6] * Y[6],
        X[0] * Y[1] + X[3] * Y[4] + X[6] * Y[7],
        X[0] * Y[2] + X[3] * Y[5] + X[6] * Y[8],
        X[1] * Y[1] + X[4] * Y[4] + X[7] * Y[7],
        X[1] * Y[2] + X[4] * Y[5] + X[7] * Y[8],
        X[2] * Y[2] + X[5] * Y[5] + X[8] * Y[8],
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def scale(s: float, X: Matrix) -> Matrix:
    """Return s X."""
    a, b, c, d, e, f, g, h, i = X
    return s * a, s * b, s * c, s * d, s * e, s * f, s * g, s * h, s * i


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def add(X: Matrix, Y: Matrix) -> Matrix:
    """Return X + Y."""
    a, b, c, d, e, f, g, h, i = X
    j, k, m, n, p, q, r, s, t = Y
    return a + j, b + k, c + m, d + n, e + p, f + q, g + r, h + s, i + t


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def transpose(X: Matrix) -> Matrix:
    """Return X^T."""
    return X[0], X[3], X[6], X[1], X[4], X[7], X[2], X[5], X[8]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def subtract(X: Matrix, Y: Matrix) -> Matrix:
    """Return X - Y."""
    return add(X, scale(-1.0, Y))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_scale(s: float, A: Symmetric) -> Symmetric:
    """Return s A."""
    return s * A[0], s * A[1], s * A[2], s * A[3], s * A[4], s * A[5]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def full(A: Symmetric) -> Matrix:
    """Return A with all its nine entries."""
    return A[0], A[1], A[2], A[1], A[3], A[4], A[2], A[4], A[5]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def unit(k: int) -> Matrix:
    """Return the matrix of zeros but for a one in entry ``k``."""
    return (
        1.0 if k == 0 else 0.0,
        1.0 if k == 1 else 0.0,
        1.0 if k == 2 else 0.0,
        1.0 if k == 3 else 0.0,
        1.0 if k == 4 else 0.0,
        1.0 if k == 5 else 0.0,
        1.0 if k == 6 else 0.0,
        1.0 if k == 7 else 0.0,
        1.0 if k == 8 else 0.0,
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_unit(number: int) -> Matrix:
    """Return the derivative of A by its ``number``-th entry."""
    row = SYM_ROW[number]
    column = SYM_COLUMN[number]
    entry = unit(3 * row + column)
    return entry if row == column else add(entry, unit(3 * column + row))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def symmetric_inverse(A: Symmetric) -> Symmetric:
    """Return A^-1."""
    return symmetric_scale(1.0 / symmetric_determinant(A), symmetric_cofactor(A))


@nb.njit(cache=True, error_model="numpy")
def multiply(X: Floats, Y: Floats, out: Floats) -> None:
    """Write X Y, all (3, 3), into ``out``."""
    for i in range(3):
        for j in range(3):
            out[i, j] = X[i, 0] * Y[0, j] + X[i, 1] * Y[1, j] + X[i, 2] * Y[2, j]


@nb.njit(cache=True, error_model="numpy")
def _largest_root(square: float, cofactors: float, J: float) -> tuple[float, float]:
    """Return t and f'(t) for |G|^2, |cof G|^2 and det G; f' = 0 where it must not be trusted."""
    t = math.sqrt(3.0 * square)
    # two to four steps are usual
    for _ in range(30):
        d = t * t - square
        slope = 4.0 * t * d - 8.0 * J
        step = (d * d - 4.0 * cofactors - 8.0 * J * t) / slope
        t -= step
        if abs(step) <= CONVERGED * t:
            slope = 4.0 * t * (t * t - square) - 8.0 * J
            if slope > CONDITION * t * t * t:
                return t, slope
            break
    return t, 0.0


@nb.njit(cache=True, error_model="numpy")
def stretch(G: Matrix) -> float:
    """Return tr P = s1 + s2 + s3."""
    C = cofactor(G)
    J = G[0] * C[0] + G[1] * C[1] + G[2] * C[2]
    t, slope = _largest_root(dot(G, G), dot(C, C), J)
    if slope == 0.0:
        t, _, _ = _by_singular_vectors(G)
    return t


@nb.njit(cache=True, error_model="numpy")
def polar(G: Matrix) -> tuple[float, Matrix, Symmetric]:
    """Return tr P, R and Y^-1."""
    C = cofactor(G)
    square = dot(G, G)
    J = G[0] * C[0] + G[1] * C[1] + G[2] * C[2]
    t, slope = _largest_root(square, dot(C, C), J)
    if slope == 0.0:
        return _by_singular_vectors(G)
    # u G - v G G^T G + w cof G with the sum's own t, I, J
    v = 8.0 / slope
    u = (4.0 * (t * t - square) + 8.0 * square) / slope
    w = 8.0 * t / slope
    cubic = times(G, symmetric_product(G, G))
    R = add(subtract(scale(u, G), scale(v, cubic)), scale(w, C))
    # Y = t I - R^T G, symmetric, and its inverse by the adjugate
    xx, xy, xz, yy, yz, zz = symmetric_product(R, G)
    adjugate = symmetric_cofactor((t - xx, -xy, -xz, t - yy, -yz, t - zz))
    return t, R, symmetric_scale(v, adjugate)


@nb.njit(cache=True, error_model="numpy")
def _by_singular_vectors(G: Matrix) -> tuple[float, Matrix, Symmetric]:
    """Return tr P, R and Y^-1 where two singular values nearly cancel or vanish."""
    M = np.empty((3, 3))
    U = np.empty((3, 3))
    V = np.empty((3, 3))
    s = np.empty(3)
    for i in range(3):
        for j in range(3):
            M[i, j] = G[3 * i + j]
    signed_svd(M, U, s, V)
    t = s[0] + s[1] + s[2]
    R = np.zeros((3, 3))
    Y = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                R[i, j] += U[i, k] * V[j, k]
                Y[i, j] += V[i, k] * V[j, k] / max(t - s[k], LEAST_SUM)
    return (
        t,
        (R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]),
        (Y[0, 0], Y[0, 1], Y[0, 2], Y[1, 1], Y[1, 2], Y[2, 2]),
    )
