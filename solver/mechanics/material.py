"""The active flesh of one tetrahedron: energy density, stress and Hessian modes.

    psi(F, A) = mu |F - R A|^2 + lambda/2 tr(P - I)^2 + kappa (det F - det A)^2 + beta(det F)

with R the rotation nearest to F A, F = Q P the polar decomposition, A the symmetric activation of
the tet (muscle geometry paper, eq. of the active corotated energy; SYSTEM: "S, energy") and beta a
barrier that is zero while det F > J0 and infinite at det F <= 0, so that no element inverts. The
muscle geometry paper has kappa = 0, Phace lambda = 0 and kappa = 3 mu.

The rotation must minimise the *whole* first term, R = polar(F A): with R = polar(F) the gradient
2 mu (F - R A) would not be the derivative of the energy.

The Hessian by F is a multiple of the identity plus rank-one modes, sum_k c_k w_k w_k^T, so neither
a 9x9 nor a 12x12 matrix is ever decomposed.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from solver.mechanics.svd3 import signed_svd
from solver.surface import Floats

MODES = 8
"""Three twists of F A, the trace and three twists of F, and the determinant."""

SYM_ROW = (0, 0, 0, 1, 1, 2)
SYM_COLUMN = (0, 1, 2, 1, 2, 2)
"""Sym(3) in the order xx, xy, xz, yy, yz, zz."""

BARRIER_START = 0.35
"""det F below which the barrier acts; no expression of a face needs more compression than that."""


@nb.njit(cache=True, error_model="numpy")
def barrier(J: float, stiffness: float) -> tuple[float, float, float]:
    """Return beta(J) and its first two derivatives.

    beta = -stiffness (J - J0)^2 ln(J / J0) below J0: the C2 clamped log barrier of incremental
    potential contact (Li et al. 2020, eq. 6), with det F in the place of the distance.
    """
    if J >= BARRIER_START:
        return 0.0, 0.0, 0.0
    if J <= 0.0:
        return math.inf, 0.0, 0.0
    d = J - BARRIER_START
    log = math.log(J / BARRIER_START)
    value = -d * d * log
    first = -2.0 * d * log - d * d / J
    second = -2.0 * log - 4.0 * d / J + d * d / (J * J)
    return stiffness * value, stiffness * first, stiffness * second


@nb.njit(cache=True, error_model="numpy")
def volumetric(
    J: float, target: float, kappa: float, stiffness: float
) -> tuple[float, float, float]:
    """Return g(J) = kappa (J - target)^2 + beta(J) and its first two derivatives by J."""
    value, first, second = barrier(J, stiffness)
    d = J - target
    return value + kappa * d * d, first + 2.0 * kappa * d, second + 2.0 * kappa


@nb.njit(cache=True, error_model="numpy")
def determinant(F: Floats) -> float:
    """Return det F of a (3, 3) matrix."""
    return float(
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )


@nb.njit(cache=True, error_model="numpy")
def cofactor(F: Floats, out: Floats) -> None:
    """Write d(det F)/dF, shape (3, 3), into ``out``."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            out[i, j] = F[a, c] * F[b, d] - F[a, d] * F[b, c]


@nb.njit(cache=True, error_model="numpy")
def multiply(X: Floats, Y: Floats, out: Floats) -> None:
    """Write X Y, all (3, 3), into ``out``."""
    for i in range(3):
        for j in range(3):
            out[i, j] = X[i, 0] * Y[0, j] + X[i, 1] * Y[1, j] + X[i, 2] * Y[2, j]


@nb.njit(cache=True, error_model="numpy")
def symmetric(a: Floats, out: Floats) -> None:
    """Write S(a), (3, 3), from a (6,) in the order xx, xy, xz, yy, yz, zz."""
    out[0, 0] = a[0]
    out[0, 1] = out[1, 0] = a[1]
    out[0, 2] = out[2, 0] = a[2]
    out[1, 1] = a[3]
    out[1, 2] = out[2, 1] = a[4]
    out[2, 2] = a[5]


@nb.njit(cache=True, error_model="numpy")
def rotation(U: Floats, V: Floats, out: Floats) -> None:
    """Write U V^T, (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = U[i, 0] * V[j, 0] + U[i, 1] * V[j, 1] + U[i, 2] * V[j, 2]


@nb.njit(cache=True, error_model="numpy")
def twist(U: Floats, V: Floats, i: int, j: int, out: Floats) -> None:
    """Write the twist mode U (e_i e_j^T - e_j e_i^T) V^T / sqrt(2), (3, 3)."""
    for r in range(3):
        for c in range(3):
            out[r, c] = (U[r, i] * V[c, j] - U[r, j] * V[c, i]) * math.sqrt(0.5)


@nb.njit(cache=True, error_model="numpy")
def density(
    F: Floats, A: Floats, mu: float, lam: float, kappa: float, stiffness: float, work: Floats
) -> float:
    """Return psi(F, A); ``work`` is scratch of shape (6, 3, 3)."""
    value, _, _ = volumetric(determinant(F), determinant(A), kappa, stiffness)
    if value == math.inf:
        return value
    s = work[5, 0]
    multiply(F, A, work[0])
    signed_svd(work[0], work[1], s, work[2])
    stretch = s[0] + s[1] + s[2]
    squares = 0.0
    for i in range(3):
        for j in range(3):
            squares += F[i, j] * F[i, j] + A[i, j] * A[i, j]
    value += mu * (squares - 2.0 * stretch)
    signed_svd(F, work[1], s, work[2])
    trace = s[0] + s[1] + s[2] - 3.0
    return float(value + 0.5 * lam * trace * trace)


@nb.njit(cache=True, error_model="numpy")
def stress(
    F: Floats,
    A: Floats,
    mu: float,
    lam: float,
    kappa: float,
    stiffness: float,
    work: Floats,
    out: Floats,
) -> None:
    """Write d psi/dF, the first Piola-Kirchhoff stress (3, 3); ``work`` is (6, 3, 3)."""
    s = work[5, 0]
    multiply(F, A, work[0])
    signed_svd(work[0], work[1], s, work[2])
    rotation(work[1], work[2], work[3])
    multiply(work[3], A, work[4])
    for i in range(3):
        for j in range(3):
            out[i, j] = 2.0 * mu * (F[i, j] - work[4, i, j])
    signed_svd(F, work[1], s, work[2])
    rotation(work[1], work[2], work[3])
    trace = s[0] + s[1] + s[2] - 3.0
    _, first, _ = volumetric(determinant(F), determinant(A), kappa, stiffness)
    cofactor(F, work[4])
    for i in range(3):
        for j in range(3):
            out[i, j] += lam * trace * work[3, i, j] + first * work[4, i, j]


@nb.njit(cache=True, error_model="numpy")
def hessian_modes(
    F: Floats,
    A: Floats,
    mu: float,
    lam: float,
    kappa: float,
    stiffness: float,
    project: bool,
    work: Floats,
    c: Floats,
    W: Floats,
) -> tuple[int, float]:
    """Write the modes of d2 psi/dF2 = 2 mu I + sum_k c_k W_k W_k^T + g' d2(det F)/dF2.

    ``c`` (MODES,) and ``W`` (MODES, 3, 3) are filled; returned are the number of modes and g', the
    factor of the determinant's curvature (zero when projected). With ``project`` the sum is
    positive semi-definite: each term is projected by itself.
    """
    s = work[5, 0]
    multiply(F, A, work[0])
    signed_svd(work[0], work[1], s, work[2])
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        twist(work[1], work[2], i, j, work[3])
        multiply(work[3], A, W[k])
        c[k] = -2.0 * mu * 2.0 / max(s[i] + s[j], 1e-8)
    if project:
        _clamp_twists(c, W, mu)
    signed_svd(F, work[1], s, work[2])
    rotation(work[1], work[2], W[3])
    c[3] = lam
    trace = s[0] + s[1] + s[2] - 3.0
    count = 4
    if trace > 0.0 or not project:
        for i, j in ((0, 1), (0, 2), (1, 2)):
            twist(work[1], work[2], i, j, W[count])
            c[count] = lam * trace * 2.0 / max(s[i] + s[j], 1e-8)
            count += 1
    _, first, second = volumetric(determinant(F), determinant(A), kappa, stiffness)
    if second != 0.0:
        cofactor(F, W[count])
        c[count] = second
        count += 1
    return count, 0.0 if project else first


@nb.njit(cache=True, error_model="numpy")
def _clamp_twists(c: Floats, W: Floats, mu: float) -> None:
    """Replace the three twist modes so that 2 mu I + sum c_k W_k W_k^T has no negative eigenvalue.

    The nonzero eigenvalues of the sum are those of the 3x3 Gram matrix of sqrt(-c_k) W_k.
    """
    gram = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            dot = 0.0
            for r in range(3):
                for q in range(3):
                    dot += W[i, r, q] * W[j, r, q]
            gram[i, j] = math.sqrt(c[i] * c[j]) * dot
    values, vectors = np.linalg.eigh(gram)
    modes = np.zeros((3, 3, 3))
    for k in range(3):
        for i in range(3):
            for r in range(3):
                for q in range(3):
                    modes[k, r, q] += vectors[i, k] * math.sqrt(-c[i]) * W[i, r, q]
    for k in range(3):
        W[k] = modes[k]
        c[k] = -min(1.0, 2.0 * mu / max(values[k], 1e-300))


@nb.njit(cache=True, error_model="numpy")
def stress_by_activation(
    F: Floats, A: Floats, mu: float, kappa: float, work: Floats, out: Floats
) -> None:
    """Write d(stress)/da, shape (3, 3, 6): the stress's change by each entry of a in S(a).

    From P = 2 mu (F - R A) + 2 kappa (det F - det A) cof F + ..., with
    dR = sum_twists 2/(s_i + s_j) w <w, F dA> and d(det A) = <cof A, dA>.
    """
    s = work[5, 0]
    multiply(F, A, work[0])
    signed_svd(work[0], work[1], s, work[2])
    rotation(work[1], work[2], work[3])
    cofactor(F, work[4])
    cofactor(A, work[0])
    for column in range(6):
        r, q = SYM_ROW[column], SYM_COLUMN[column]
        volume = 2.0 * kappa * work[0, r, q] * (1.0 if r == q else 2.0)
        for i in range(3):
            for j in range(3):
                out[i, j, column] = -volume * work[4, i, j]
        for i in range(3):
            out[i, q, column] -= 2.0 * mu * work[3, i, r]
            if r != q:
                out[i, r, column] -= 2.0 * mu * work[3, i, q]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        twist(work[1], work[2], i, j, work[4])
        multiply(work[4], A, work[0])
        scale = 2.0 * mu * 2.0 / max(s[i] + s[j], 1e-8)
        for column in range(6):
            r, q = SYM_ROW[column], SYM_COLUMN[column]
            # <w, F B> for the basis matrix B with ones at (r, q) and (q, r)
            dot = 0.0
            for k in range(3):
                dot += work[4, k, q] * F[k, r]
                if r != q:
                    dot += work[4, k, r] * F[k, q]
            for k in range(3):
                for m in range(3):
                    out[k, m, column] -= scale * dot * work[0, k, m]
