"""Mooney-Rivlin flesh of one tetrahedron: isochoric, and nearly incompressible beside it.

    psi(F, A) = det A w(G),   G = F A^-1
    w(G) = mu10 (J^(-2/3) I1 - 3) + mu01 (J^(-4/3) I2 - 3) + lambda/2 (J - 1)^2 + kappa (J - 1)^2
           + beta(J),   I1 = |G|^2, I2 = |cof G|^2, J = det G

Mooney 1940 and Rivlin 1948, of the part of G without change of volume; lambda + 2 kappa is the bulk
modulus, mu = 2 (mu10 + mu01) the shear modulus. A is a shape to come to rest in, as that of
:mod:`solver.mechanics.materials.neo_hookean`, and beta is
:func:`solver.mechanics.materials.barrier`.

With c = <cof G, dG> and dC = d(cof G) the second derivative is a sum of squares but for its last
two parts, the one a number times c^2, the other a curvature of det G and cof G:

    d2w = 2 mu10 J^p |dG + p c/J G|^2 + 2 mu01 J^q |dC + q c/J cof G|^2 + gamma c^2 + <H, d2(cof)>
    gamma = (2/9 mu10 J^p I1 - 4/9 mu01 J^q I2) / J^2 + g''(J),   p = -2/3, q = -4/3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

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
    unit,
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

SECOND = 0.5  # mu01 / (mu10 + mu01): what the second invariant has of the shear modulus


class _Shape(NamedTuple):
    """The elastic deformation G, and w's derivatives by its parts."""

    G: Matrix
    C: Matrix  # cof G
    K: Matrix  # half the derivative of I2
    J: float
    first: float  # 2 mu10 J^p
    second: float  # 2 mu01 J^q
    pressure: float  # dw/dJ, G and cof G kept
    bulk: float  # g''(J)


def from_lame(mu: Floats, lam: Floats) -> tuple[Floats, Floats]:
    """Return the law's own mu and lambda, of the bulk modulus, for Lame's at small strain."""
    return mu, lam + 2.0 / 3.0 * mu


@nb.njit(cache=True, error_model="numpy")
def density(F: Matrix, A: Symmetric, moduli: Moduli) -> float:
    """Return psi(F, A); infinite where det F <= 0 or det A <= 0."""
    mu, lam, kappa, barrier = moduli
    volume, G, J = elastic_part(F, A)
    if volume <= 0.0 or J <= 0.0:
        return math.inf
    C = cofactor(G)
    value, _, _ = volumetric(J, 1.0, kappa + 0.5 * lam, barrier)
    shrunk = math.pow(J, -2.0 / 3.0)
    value += 0.5 * mu * (1.0 - SECOND) * (shrunk * dot(G, G) - 3.0)
    value += 0.5 * mu * SECOND * (shrunk * shrunk * dot(C, C) - 3.0)
    return volume * value


@nb.njit(cache=True, error_model="numpy")
def stress(F: Matrix, A: Symmetric, moduli: Moduli) -> Matrix:
    """Return d psi/dF = w'(G) cof A."""
    _, G, J = elastic_part(F, A)
    at = _shape(G, J, moduli)
    return times(_elastic_stress(at), symmetric_cofactor(A))


@nb.njit(cache=True, error_model="numpy")
def hessian_modes(
    F: Matrix, A: Symmetric, moduli: Moduli, project: float, modes: Modes
) -> tuple[int, Symmetric, Matrix]:
    """Write the modes of d2 psi/dF2: see :func:`solver.mechanics.laws.hessian_modes`.

    Nine are of the cofactor's change, two of c^2 and of its products.
    """
    inverse = symmetric_inverse(A)
    volume, G, J = elastic_part(F, A)
    left = modes.left
    right = modes.right
    at = _shape(G, J, moduli)
    p = -2.0 / (3.0 * at.J)
    q = -4.0 / (3.0 * at.J)
    for mode in range(9):
        # the cross product is symmetric: <E, G x dG> = <G x E, dG>
        W = times(_cross(at.G, unit(mode)), inverse)
        for entry in range(9):
            right[mode, entry] = W[entry]
            left[mode, entry] = volume * at.second * W[entry]
    one = dot(at.G, at.G)
    two = dot(at.C, at.C)
    gamma = (at.first * one / 9.0 - 2.0 * at.second * two / 9.0) / (at.J * at.J) + at.bulk
    if gamma < 0.0:
        gamma *= 1.0 - project
    square = at.first * p * p * one + at.second * q * q * two + gamma
    C = times(at.C, inverse)
    mixed = times(add(scale(at.first * p, at.G), scale(at.second * q, at.K)), inverse)
    for entry in range(9):
        right[9, entry] = C[entry]
        left[9, entry] = volume * (square * C[entry] + mixed[entry])
        right[10, entry] = mixed[entry]
        left[10, entry] = volume * C[entry]
    metric = grown_metric(volume * at.first, inverse)
    bent = add(scale(at.pressure, at.G), scale(at.second, at.C))
    return 11, metric, scale(1.0 - project, times(bent, A))


@nb.njit(cache=True, error_model="numpy")
def stress_by_activation(
    F: Matrix,
    A: Symmetric,
    moduli: Moduli,
    modes: Modes,  # noqa: ARG001 - of laws that need room
    out: Floats,
) -> None:
    """Write d(stress)/da, shape (6, 9): P = w'(G) changes by dP[dG], where dG = -G dA A^-1."""
    inverse = symmetric_inverse(A)
    _, G, J = elastic_part(F, A)
    at = _shape(G, J, moduli)
    P = _elastic_stress(at)
    for column in range(6):
        dG = scale(-1.0, product(at.G, times(symmetric_unit(column), inverse)))
        write_growth(column, P, _stress_change(at, dG), A, inverse, out)


@nb.njit(cache=True, error_model="numpy")
def _shape(G: Matrix, J: float, moduli: Moduli) -> _Shape:
    mu, lam, kappa, barrier = moduli
    C = cofactor(G)
    _, slope, bulk = volumetric(J, 1.0, kappa + 0.5 * lam, barrier)
    shrunk = math.pow(J, -2.0 / 3.0)
    first = mu * (1.0 - SECOND) * shrunk
    second = mu * SECOND * shrunk * shrunk
    pressure = slope - (first * dot(G, G) + 2.0 * second * dot(C, C)) / (3.0 * J)
    return _Shape(G, C, _cross(C, G), J, first, second, pressure, bulk)


@nb.njit(cache=True, error_model="numpy")
def _elastic_stress(at: _Shape) -> Matrix:
    """Return w'(G)."""
    return add(add(scale(at.first, at.G), scale(at.second, at.K)), scale(at.pressure, at.C))


@nb.njit(cache=True, error_model="numpy")
def _stress_change(at: _Shape, D: Matrix) -> Matrix:
    """Return the derivative of w'(G) along D."""
    turning = _cross(at.G, D)
    p = -2.0 / (3.0 * at.J)
    q = -4.0 / (3.0 * at.J)
    j = dot(at.C, D)
    one = dot(at.G, at.G)
    two = dot(at.C, at.C)
    # first and second change by p j and q j of them
    pressure = 0.5 * at.first * p * (2.0 * dot(at.G, D) + one * (p - 1.0 / at.J) * j)
    pressure += 0.5 * at.second * q * (2.0 * dot(at.K, D) + two * (q - 1.0 / at.J) * j)
    pressure += at.bulk * j
    change = add(scale(at.first, D), scale(at.first * p * j, at.G))
    bent = add(_cross(turning, at.G), _cross(at.C, D))
    change = add(change, add(scale(at.second, bent), scale(at.second * q * j, at.K)))
    return add(change, add(scale(pressure, at.C), scale(at.pressure, turning)))


@nb.njit(cache=True, error_model="numpy")
def _cross(X: Matrix, Y: Matrix) -> Matrix:
    """Return X x Y, the cofactor's derivative at X along Y: bilinear and symmetric."""
    return subtract(subtract(cofactor(add(X, Y)), cofactor(X)), cofactor(Y))
