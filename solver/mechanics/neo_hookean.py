"""Stable Neo-Hookean flesh of one tetrahedron (Smith, De Goes, Kim 2018).

    psi(G) = mu/2 (I_C - 3) - mu/2 ln((I_C + 1) / 4) + lambda/2 ((J - alpha)^2 - (1 - alpha)^2)
             + kappa (J - 1)^2 + beta(J),   I_C = |G|^2, J = det G, alpha = 1 + 3 mu / (4 lambda)

No rotation is factored out, so that it is smooth everywhere, and alpha leaves it without stress at
G = I. G is what is elastic in F: F A^-1 for flesh of activation A, which then is a shape to come to
rest in, like growth (:func:`released`). Its mu and lambda are not Lame's:
see :func:`from_lame`. beta is the barrier of :mod:`solver.mechanics.material`.
"""

from __future__ import annotations

import math

import numba as nb

from solver.mechanics.material import (
    determinant,
    symmetric_cofactor,
    symmetric_determinant,
    volumetric,
)
from solver.mechanics.polar import Matrix, cofactor, dot
from solver.surface import Floats


def from_lame(mu: Floats, lam: Floats) -> tuple[Floats, Floats]:
    """Return the law's own mu and lambda: at small strain it has these of Lame (their eq. 48)."""
    return 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu


@nb.njit(cache=True, error_model="numpy")
def density(G: Matrix, mu: float, lam: float, kappa: float, stiffness: float) -> float:
    """Return psi(G); infinite where det G <= 0."""
    J = determinant(G)
    if J <= 0.0:
        return math.inf
    value, _, _ = volumetric(J, 1.0, kappa, stiffness)
    squares = dot(G, G)
    # lambda/2 ((J - alpha)^2 - (1 - alpha)^2), alpha put in: lambda need not be apart from zero
    pressure = 0.5 * (J - 1.0) * (lam * (J - 1.0) - 1.5 * mu)
    return value + pressure + 0.5 * mu * (squares - 3.0 - math.log(0.25 * (squares + 1.0)))


@nb.njit(cache=True, error_model="numpy")
def stress(G: Matrix, mu: float, lam: float, kappa: float, stiffness: float) -> Matrix:
    """Return d psi/dG."""
    J = determinant(G)
    _, first, _ = volumetric(J, 1.0, kappa, stiffness)
    first += lam * (J - 1.0) - 0.75 * mu
    C = cofactor(G)
    m = mu * (1.0 - 1.0 / (dot(G, G) + 1.0))
    return (
        m * G[0] + first * C[0],
        m * G[1] + first * C[1],
        m * G[2] + first * C[2],
        m * G[3] + first * C[3],
        m * G[4] + first * C[4],
        m * G[5] + first * C[5],
        m * G[6] + first * C[6],
        m * G[7] + first * C[7],
        m * G[8] + first * C[8],
    )


@nb.njit(cache=True, error_model="numpy")
def hessian_modes(
    G: Matrix,
    mu: float,
    lam: float,
    kappa: float,
    stiffness: float,
    project: float,
    left: Floats,
    right: Floats,
) -> tuple[int, float, float]:
    """Write the modes of d2 psi/dG2 = c I + sum_k left_k right_k^T + g d2(det G)/dG2.

    As :func:`solver.mechanics.material.hessian_modes`; returned are the number of modes, c and g.
    All but the determinant's curvature is positive semi-definite, so that ``project`` takes that.
    """
    J = determinant(G)
    _, first, second = volumetric(J, 1.0, kappa, stiffness)
    first += lam * (J - 1.0) - 0.75 * mu
    second += lam
    shrunk = 1.0 / (dot(G, G) + 1.0)
    C = cofactor(G)
    for entry in range(9):
        right[0, entry] = G[entry]
        left[0, entry] = 2.0 * mu * shrunk * shrunk * G[entry]
        right[1, entry] = C[entry]
        left[1, entry] = second * C[entry]
    return 2, mu * (1.0 - shrunk), (1.0 - project) * first


@nb.njit(cache=True, parallel=True, error_model="numpy")
def released(N: Floats, volume: Floats, a: Floats, out_N: Floats, out_volume: Floats) -> None:
    """Fill shape gradients A^-1 N (n, 4, 3) and volumes V det A (n,): F becomes F A^-1.

    What each tet would be without the stress of its activation ``a`` (n, 6), as its rest.
    """
    for e in nb.prange(len(N)):
        A = (a[e, 0], a[e, 1], a[e, 2], a[e, 3], a[e, 4], a[e, 5])
        xx, xy, xz, yy, yz, zz = symmetric_cofactor(A)
        det = symmetric_determinant(A)
        out_volume[e] = volume[e] * det
        for v in range(4):
            n0, n1, n2 = N[e, v, 0] / det, N[e, v, 1] / det, N[e, v, 2] / det
            out_N[e, v, 0] = xx * n0 + xy * n1 + xz * n2
            out_N[e, v, 1] = xy * n0 + yy * n1 + yz * n2
            out_N[e, v, 2] = xz * n0 + yz * n1 + zz * n2
