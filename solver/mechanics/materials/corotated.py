"""The active flesh of one tetrahedron: energy density, stress and Hessian modes.

    psi(F, A) = mu |F - R A|^2 + lambda/2 tr(P - I)^2 + kappa (det F - det A)^2 + beta(det F)

with R the rotation nearest to F A, F = Q P the polar decomposition, A the symmetric activation of
the tet (muscle geometry paper, eq. of the active corotated energy) and beta a barrier that is zero
while det F > J0 and infinite at det F <= 0, so that no element inverts. The muscle geometry paper
has kappa = 0, Phace lambda = 0 and kappa = 3 mu.

The rotation must minimise the *whole* first term, R = polar(F A): with R = polar(F) the gradient
2 mu (F - R A) would not be the derivative of the energy.

The Hessian by F is a multiple of the identity plus a handful of modes, so that neither a 9x9 nor a
12x12 matrix is ever decomposed. Matrices are tuples (:mod:`solver.mechanics.linalg3`); the
functions are those that :mod:`solver.mechanics.laws` asks of a law.
"""

from __future__ import annotations

import math

import numba as nb

from solver.mechanics.linalg3 import (
    SYM_COLUMN,
    SYM_ROW,
    Matrix,
    Symmetric,
    add,
    cofactor,
    determinant,
    dot,
    full,
    multiply,
    polar,
    scale,
    signed_svd,
    stretch,
    subtract,
    symmetric_cofactor,
    symmetric_determinant,
    symmetric_product,
    symmetric_scale,
    times,
)
from solver.mechanics.materials import Modes, Moduli, volumetric
from solver.surface import Floats


@nb.njit(cache=True, error_model="numpy")
def density(F: Matrix, A: Symmetric, moduli: Moduli) -> float:
    """Return psi(F, A); infinite where det F <= 0."""
    mu, lam, kappa, barrier = moduli
    J = determinant(F)
    if J <= 0.0:
        return math.inf
    value, _, _ = volumetric(J, symmetric_determinant(A), kappa, barrier)
    squares = dot(F, F) + A[0] * A[0] + A[3] * A[3] + A[5] * A[5]
    squares += 2.0 * (A[1] * A[1] + A[2] * A[2] + A[4] * A[4])
    trace = stretch(F) - 3.0
    return value + mu * (squares - 2.0 * stretch(times(F, A))) + 0.5 * lam * trace * trace


@nb.njit(cache=True, error_model="numpy")
def stress(F: Matrix, A: Symmetric, moduli: Moduli) -> Matrix:
    """Return d psi/dF, the first Piola-Kirchhoff stress."""
    mu, lam, kappa, barrier = moduli
    _, R, _ = polar(times(F, A))
    B = times(R, A)
    t, Q, _ = polar(F)
    C = cofactor(F)
    _, first, _ = volumetric(determinant(F), symmetric_determinant(A), kappa, barrier)
    shape = add(scale(2.0 * mu, subtract(F, B)), scale(lam * (t - 3.0), Q))
    return add(shape, scale(first, C))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def hessian_modes(
    F: Matrix, A: Symmetric, moduli: Moduli, project: float, modes: Modes
) -> tuple[int, Symmetric, Matrix]:
    """Write the modes of d2 psi/dF2: see :func:`solver.mechanics.laws.hessian_modes`.

    They are three twists of F A, three twists of F, its trace and its determinant.
    """
    mu, lam, kappa, barrier = moduli
    keep = 1.0 - project
    _, R, Y = polar(times(F, A))
    if project > 0.0:
        a, b, c, d, e, f = symmetric_scale(keep, Y)
        g, h, i, j, k, m = symmetric_scale(project, _clamp(Y, A, modes.work))
        Y = (a + g, b + h, c + i, d + j, e + k, f + m)
    _twists(R, A, Y, -2.0 * mu, modes, 0)
    count = 3
    t, Q, Y = polar(F)
    trace = lam * (t - 3.0)
    if trace < 0.0:
        trace *= keep
    if trace != 0.0:
        _twists(Q, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), Y, trace, modes, count)
        count += 3
    if lam > 0.0:
        _single(Q, lam, modes, count)
        count += 1
    _, first, second = volumetric(determinant(F), symmetric_determinant(A), kappa, barrier)
    if second != 0.0:
        _single(cofactor(F), second, modes, count)
        count += 1
    g = keep * first
    metric = (2.0 * mu, 0.0, 0.0, 2.0 * mu, 0.0, 2.0 * mu)
    return count, metric, scale(g, F)


@nb.njit(cache=True, error_model="numpy")
def _single(W: Matrix, scale: float, modes: Modes, k: int) -> None:
    for entry in range(9):
        modes.right[k, entry] = W[entry]
        modes.left[k, entry] = scale * W[entry]


@nb.njit(cache=True, error_model="numpy")
def _twists(R: Matrix, A: Symmetric, Y: Symmetric, scale: float, modes: Modes, k: int) -> None:
    """Write the three modes of the rotation: scale times the second derivative of t(F A) by F.

    The derivative is sum_ij Y^-1_ij W_i W_j^T with W_i = R [e_i]x A, from dR = R [w]x.
    """
    left, right, (xx, xy, xz, yy, yz, zz) = modes.left, modes.right, A
    for row in range(3):
        r0 = R[3 * row]
        r1 = R[3 * row + 1]
        r2 = R[3 * row + 2]
        right[k, 3 * row] = r2 * xy - r1 * xz
        right[k, 3 * row + 1] = r2 * yy - r1 * yz
        right[k, 3 * row + 2] = r2 * yz - r1 * zz
        right[k + 1, 3 * row] = r0 * xz - r2 * xx
        right[k + 1, 3 * row + 1] = r0 * yz - r2 * xy
        right[k + 1, 3 * row + 2] = r0 * zz - r2 * xz
        right[k + 2, 3 * row] = r1 * xx - r0 * xy
        right[k + 2, 3 * row + 1] = r1 * xy - r0 * yy
        right[k + 2, 3 * row + 2] = r1 * xz - r0 * yz
    xx, xy, xz, yy, yz, zz = Y
    for entry in range(9):
        w0 = right[k, entry]
        w1 = right[k + 1, entry]
        w2 = right[k + 2, entry]
        left[k, entry] = scale * (xx * w0 + xy * w1 + xz * w2)
        left[k + 1, entry] = scale * (xy * w0 + yy * w1 + yz * w2)
        left[k + 2, entry] = scale * (xz * w0 + yz * w1 + zz * w2)


@nb.njit(cache=True, error_model="numpy")
def _clamp(Y: Symmetric, A: Symmetric, work: Floats) -> Symmetric:
    """Return M <= Y^-1 such that I - sum_ij M_ij W_i W_j^T has no negative eigenvalue.

    With Y^-1 = L L^T those of the sum are the eigenvalues of L^T G L, where the Gram matrix of the
    twists is G_ij = <W_i, W_j> = tr(A^2) I - A^2; they are cut at one.
    """
    L = work[0]
    gram = work[1]
    U = work[2]
    V = work[3]
    s = work[4, 0]
    L[0, 0] = math.sqrt(Y[0])
    L[1, 0], L[2, 0] = Y[1] / L[0, 0], Y[2] / L[0, 0]
    L[1, 1] = math.sqrt(Y[3] - L[1, 0] * L[1, 0])
    L[2, 1] = (Y[4] - L[1, 0] * L[2, 0]) / L[1, 1]
    L[2, 2] = math.sqrt(max(Y[5] - L[2, 0] * L[2, 0] - L[2, 1] * L[2, 1], 0.0))
    L[0, 1] = L[0, 2] = L[1, 2] = 0.0
    xx, xy, xz, yy, yz, zz = symmetric_product(full(A), full(A))
    for i in range(3):
        l0 = L[0, i]
        l1 = L[1, i]
        l2 = L[2, i]
        g0 = (yy + zz) * l0 - xy * l1 - xz * l2
        g1 = (xx + zz) * l1 - xy * l0 - yz * l2
        g2 = (xx + yy) * l2 - xz * l0 - yz * l1
        for j in range(3):
            gram[i, j] = g0 * L[0, j] + g1 * L[1, j] + g2 * L[2, j]
    first = 1.0 - gram[0, 0]
    second = 1.0 - gram[1, 1]
    third = 1.0 - gram[2, 2]
    minor = first * second - gram[0, 1] * gram[0, 1]
    whole = minor * third - first * gram[1, 2] * gram[1, 2] - second * gram[0, 2] * gram[0, 2]
    whole -= 2.0 * gram[0, 1] * gram[0, 2] * gram[1, 2]
    if first > 0.0 and minor > 0.0 and whole > 0.0:
        return Y
    # of a positive semi-definite matrix the singular vectors are the eigenvectors
    signed_svd(gram, U, s, V)
    multiply(L, V, U)
    k0 = 1.0 / max(s[0], 1.0)
    k1 = 1.0 / max(s[1], 1.0)
    k2 = 1.0 / max(s[2], 1.0)
    return (
        k0 * U[0, 0] * U[0, 0] + k1 * U[0, 1] * U[0, 1] + k2 * U[0, 2] * U[0, 2],
        k0 * U[0, 0] * U[1, 0] + k1 * U[0, 1] * U[1, 1] + k2 * U[0, 2] * U[1, 2],
        k0 * U[0, 0] * U[2, 0] + k1 * U[0, 1] * U[2, 1] + k2 * U[0, 2] * U[2, 2],
        k0 * U[1, 0] * U[1, 0] + k1 * U[1, 1] * U[1, 1] + k2 * U[1, 2] * U[1, 2],
        k0 * U[1, 0] * U[2, 0] + k1 * U[1, 1] * U[2, 1] + k2 * U[1, 2] * U[2, 2],
        k0 * U[2, 0] * U[2, 0] + k1 * U[2, 1] * U[2, 1] + k2 * U[2, 2] * U[2, 2],
    )


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def stress_by_activation(
    F: Matrix, A: Symmetric, moduli: Moduli, modes: Modes, out: Floats
) -> None:
    """Write d(stress)/da, shape (6, 9): the stress's change by each entry of a in S(a).

    The stress 2 mu (F - R A) + 2 kappa (det F - det A) cof F + ... changes by
    d(R A) = R dA + R [w]x A, Y w = axl(D dA - dA D^T), D = R^T F, and by d(det A) = <cof A, dA>.
    ``modes`` are scratch.
    """
    mu = moduli[0]
    kappa = moduli[2]
    _, R, Y = polar(times(F, A))
    _twists(R, A, Y, 1.0, modes, 0)
    c0 = _rotated_back(R, F[0], F[3], F[6])
    c1 = _rotated_back(R, F[1], F[4], F[7])
    c2 = _rotated_back(R, F[2], F[5], F[8])
    axes = (
        (0.0, -c0[2], c0[1]),
        (c0[2], -c1[2], c1[1] - c0[0]),
        (-c0[1], c0[0] - c2[2], c2[1]),
        (c1[2], 0.0, -c1[0]),
        (c2[2] - c1[1], c1[0], -c2[0]),
        (-c2[1], c2[0], 0.0),
    )
    C = cofactor(F)
    B = symmetric_cofactor(A)
    for column in range(6):
        z0, z1, z2 = axes[column]
        r = SYM_ROW[column]
        q = SYM_COLUMN[column]
        volume = 2.0 * kappa * B[column] * (1.0 if r == q else 2.0)
        for k in range(9):
            turn = z0 * modes.left[0, k] + z1 * modes.left[1, k] + z2 * modes.left[2, k]
            out[column, k] = -2.0 * mu * turn - volume * C[k]
        for i in range(3):
            out[column, 3 * i + q] -= 2.0 * mu * R[3 * i + r]
            if r != q:
                out[column, 3 * i + r] -= 2.0 * mu * R[3 * i + q]


@nb.njit(cache=True, error_model="numpy")
def _rotated_back(R: Matrix, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        R[0] * x + R[3] * y + R[6] * z,
        R[1] * x + R[4] * y + R[7] * z,
        R[2] * x + R[5] * y + R[8] * z,
    )
