"""The laws of flesh, a module each, of one tetrahedron; here what several have in common.

A law has four functions, those of :mod:`solver.mechanics.laws`. All keep their volume by the same
barrier. Laws of a shape to come to rest in share how activations grow it,

    psi(F, A) = det A w(G),   G = F A^-1,   d psi/dF = P cof A,   P = w'(G).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb

from solver.mechanics.linalg3 import (
    Matrix,
    Symmetric,
    determinant,
    dot,
    full,
    product,
    symmetric_cofactor,
    symmetric_determinant,
    symmetric_inverse,
    symmetric_product,
    symmetric_scale,
    symmetric_unit,
    times,
)
from solver.surface import Floats

Moduli = tuple[float, float, float, float]  # mu, lambda, kappa and the barrier's weight: stresses

MOST_MODES = 12  # a law's Hessian has no more


class Modes(NamedTuple):
    """Modes of a Hessian, sum_k left_k right_k^T, and room to find them in."""

    left: Floats  # (MOST_MODES, 9)
    right: Floats
    work: Floats  # (5, 3, 3)


BARRIER_START = 0.35  # det F below which the barrier acts: no expression compresses more


@nb.njit(cache=True, error_model="numpy")
def barrier(J: float, weight: float) -> tuple[float, float, float]:
    """Return beta(J) and its first two derivatives.

    beta = -weight (J - J0)^2 ln(J / J0) below J0: the C2 clamped log barrier of incremental
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
    return weight * value, weight * first, weight * second


@nb.njit(cache=True, error_model="numpy")
def volumetric(J: float, target: float, kappa: float, weight: float) -> tuple[float, float, float]:
    """Return g(J) = kappa (J - target)^2 + beta(J) and its first two derivatives by J."""
    value, first, second = barrier(J, weight)
    d = J - target
    return value + kappa * d * d, first + 2.0 * kappa * d, second + 2.0 * kappa


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def elastic_part(F: Matrix, A: Symmetric) -> tuple[float, Matrix, float]:
    """Return det A, G and det G; the last two mean nothing where det A <= 0."""
    G = times(F, symmetric_inverse(A))
    return symmetric_determinant(A), G, determinant(G)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def grown_metric(m: float, inverse: Symmetric) -> Symmetric:
    """Return B of <dF, dF B> = m |dG|^2; ``inverse`` is A^-1."""
    return symmetric_scale(m, symmetric_product(full(inverse), full(inverse)))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def write_growth(
    column: int, P: Matrix, dP: Matrix, A: Symmetric, inverse: Symmetric, out: Floats
) -> None:
    """Write the change of P cof A by one entry of A, shape (6, 9), in its row of ``out``.

    It is dP cof A + P d(cof A), d(cof A) = <cof A, dA> A^-1 - cof A dA A^-1; ``inverse`` is A^-1.
    """
    dA = symmetric_unit(column)
    C = symmetric_cofactor(A)
    change = times(dP, C)
    whole = dot(full(C), dA)
    by_pressure = times(P, inverse)
    by_shape = product(times(P, C), times(dA, inverse))
    for k in range(9):
        out[column, k] = change[k] + whole * by_pressure[k] - by_shape[k]
