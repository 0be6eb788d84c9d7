"""Stable Neo-Hookean flesh of one tetrahedron (Smith, De Goes, Kim 2018).

    psi(F, A) = det A w(G),   G = F A^-1
    w(G) = mu/2 (I_C - 3) - mu/2 ln((I_C + 1) / 4) + lambda/2 ((J - alpha)^2 - (1 - alpha)^2)
           + kappa (J - 1)^2 + beta(J),   I_C = |G|^2, J = det G, alpha = 1 + 3 mu / (4 lambda)

No rotation is factored out, so that it is smooth everywhere, and alpha leaves it without stress at
G = I. G is what is elastic in F: an activation is a shape to come to rest in, like growth, and has
to have a volume. mu and lambda are not Lame's: see :func:`from_lame`. beta is
:func:`solver.mechanics.materials.barrier`.
"""

from __future__ import annotations

import math

import numba as nb

from solver.mechanics.linalg3 import (
    Matrix,
    Symmetric,
    add,
    cofactor,
    dot,
    product,
    scale,
    subtract,
    symmetric_cofactor,
    symmetric_inverse,
    symmetric_unit,
    times,
)
from solver.mechanics.materials import (
    Modes,
    Moduli,
    elastic_part,
    grown_metric,
    volumetric,
    write_growth,
)
from solver.surface import Floats


def from_lame(mu: Floats, lam: Floats) -> tuple[Floats, Floats]:
    """Return the law's own mu and lambda: at small strain it has these of Lame (their eq. 48)."""
    return 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def density(F: Matrix, A: Symmetric, moduli: Moduli) -> float:
    """Return psi(F, A); infinite where det F <= 0 or det A <= 0."""
    mu, lam, kappa, barrier = moduli
    volume, G, J = elastic_part(F, A)
    if volume <= 0.0 or J <= 0.0:
        return math.inf
    value, _, _ = volumetric(J, 1.0, kappa, barrier)
    # lambda/2 ((J - alpha)^2 - (1 - alpha)^2), alpha put in: lambda need not be apart from zero
    value += 0.5 * (J - 1.0) * (lam * (J - 1.0) - 1.5 * mu)
    squares = dot(G, G)
    return volume * (value + 0.5 * mu * (squares - 3.0 - math.log(0.25 * (squares + 1.0))))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def stress(F: Matrix, A: Symmetric, moduli: Moduli) -> Matrix:
    """Return d psi/dF = w'(G) cof A."""
    _, G, J = elastic_part(F, A)
    P, _, _ = _elastic_stress(G, J, moduli)
    return times(P, symmetric_cofactor(A))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def hessian_modes(
    F: Matrix, A: Symmetric, moduli: Moduli, project: float, modes: Modes
) -> tuple[int, Symmetric, Matrix]:
    """Write the modes of d2 psi/dF2: see :func:`solver.mechanics.laws.hessian_modes`.

    All but the determinant's curvature is positive semi-definite, so that ``project`` takes that.
    """
    mu = moduli[0]
    inverse = symmetric_inverse(A)
    volume, G, J = elastic_part(F, A)
    _, first, second = _elastic_stress(G, J, moduli)
    shrunk = 1.0 / (dot(G, G) + 1.0)
    W = times(G, inverse)
    C = times(cofactor(G), inverse)
    for entry in range(9):
        modes.right[0, entry] = W[entry]
        modes.left[0, entry] = volume * 2.0 * mu * shrunk * shrunk * W[entry]
        modes.right[1, entry] = C[entry]
        modes.left[1, entry] = volume * second * C[entry]
    m = volume * mu * (1.0 - shrunk)
    g = (1.0 - project) * first
    return 2, grown_metric(m, inverse), scale(g, F)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def stress_by_activation(
    F: Matrix,
    A: Symmetric,
    moduli: Moduli,
    modes: Modes,  # noqa: ARG001 - of laws that need room
    out: Floats,
) -> None:
    """Write d(stress)/da, shape (6, 9).

    P = w'(G) changes by dP[dG], where dG = -G dA A^-1 and

        dP[D] = m D + 2 mu <G, D> / (I_C + 1)^2 G + w_JJ <cof G, D> cof G + w_J d(cof G)[D].
    """
    mu = moduli[0]
    inverse = symmetric_inverse(A)
    _, G, J = elastic_part(F, A)
    P, first, second = _elastic_stress(G, J, moduli)
    K = cofactor(G)
    shrunk = 1.0 / (dot(G, G) + 1.0)
    m = mu * (1.0 - shrunk)
    s = 2.0 * mu * shrunk * shrunk
    for column in range(6):
        D = product(G, times(symmetric_unit(column), inverse))
        # d(cof G)[G dA A^-1]: the cofactor is quadratic
        turning = subtract(subtract(cofactor(add(G, D)), K), cofactor(D))
        dP = add(scale(-s * dot(G, D), G), scale(-second * dot(K, D), K))
        dP = subtract(subtract(dP, scale(m, D)), scale(first, turning))
        write_growth(column, P, dP, A, inverse, out)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _elastic_stress(G: Matrix, J: float, moduli: Moduli) -> tuple[Matrix, float, float]:
    """Return w'(G), and the first and second derivative of w by J alone."""
    mu, lam, kappa, barrier = moduli
    _, first, second = volumetric(J, 1.0, kappa, barrier)
    first += lam * (J - 1.0) - 0.75 * mu
    C = cofactor(G)
    m = mu * (1.0 - 1.0 / (dot(G, G) + 1.0))
    return add(scale(m, G), scale(first, C)), first, second + lam
