"""The laws of flesh, a module each, of one tetrahedron; here the volume's part, common to all.

A law has four functions, those of :mod:`solver.mechanics.laws`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb

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
