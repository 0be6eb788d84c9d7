"""Margins of muscles' activations within their bounds, compiled: a fit asks for them all the time.

Of each muscle S(a_j), with stretches lambda_k, the least first, along axes d_k, nine margins:

    fibre - T_j : S(a_j),    lambda_k - shortest,    longest - lambda_k,
    log volume + log det S(a_j),    log volume - log det S(a_j),

whose derivatives are -T_j, d_k d_k^T, -d_k d_k^T and +-S(a_j)^-1. ``limits`` are (fibre, shortest,
longest, log volume); ``along`` (m, 6) is T_j : dS/da, all zero for muscles without fibres.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from solver.fitting.stretches import FROBENIUS
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.linalg3 import SYM_COLUMN, SYM_ROW, symmetric_eigen
from solver.surface import Floats

COUNT = 9  # margins of a muscle


@nb.njit(cache=True, error_model="numpy")
def margins_of(a: Floats, along: Floats, limits: Floats, margins: Floats, slopes: Floats) -> None:
    """Write the ``margins`` (m, 9) of activations a (m, 6), and their ``slopes`` (m, 9, 6).

    Slopes with no rows are left out.
    """
    values = np.empty(3)
    axes = np.empty((3, 3))
    for j in range(len(a)):
        _decompose(a[j], values, axes)
        _margins(a[j], along[j], values, limits, margins[j])
        if len(slopes):
            _slopes(along[j], values, axes, slopes[j])


@nb.njit(cache=True, error_model="numpy")
def bring_inside(
    a: Floats,
    along: Floats,
    limits: Floats,
    least: Floats,
    further: float,
    rounds: int,
    shrink: float,
    shrinks: int,
) -> None:
    """Bring activations a (m, 6) to margins of ``least`` (m, 9), each by the shortest way it finds.

    It is projected onto one bound after the other, ``rounds`` times and to ``further`` times the
    margins, and then shrunk towards rest, to a part ``shrink`` at a time.
    """
    values = np.empty(3)
    axes = np.empty((3, 3))
    margins = np.empty(COUNT)
    at = np.empty(6)
    for j in range(len(a)):
        for _ in range(rounds):
            _decompose(a[j], values, axes)
            _margins(a[j], along[j], values, limits, margins)
            if not _is_below(margins, least[j]):
                break
            _project(a[j], along[j], limits, least[j], further, values, axes)
        part = 1.0
        at[:] = a[j]
        for _ in range(shrinks):
            _decompose(a[j], values, axes)
            _margins(a[j], along[j], values, limits, margins)
            if not _is_below(margins, least[j]):
                break
            part *= shrink
            for k in range(6):
                a[j, k] = IDENTITY[k] + part * (at[k] - IDENTITY[k])


@nb.njit(cache=True, error_model="numpy")
def _decompose(a: Floats, values: Floats, axes: Floats) -> None:
    """Write the stretches (3,) of S(a) and their axes, the columns of a matrix."""
    A = np.empty((3, 3))
    for k in range(6):
        A[SYM_ROW[k], SYM_COLUMN[k]] = a[k]
        A[SYM_COLUMN[k], SYM_ROW[k]] = a[k]
    symmetric_eigen(A, values, axes)


@nb.njit(cache=True, error_model="numpy")
def _margins(a: Floats, along: Floats, values: Floats, limits: Floats, out: Floats) -> None:
    size = 0.0
    for k in range(3):
        out[1 + k] = values[k] - limits[1]
        out[4 + k] = limits[2] - values[k]
        size += math.log(values[k]) if values[k] > 0.0 else -np.inf
    out[0] = limits[0] - _fibre(a, along)
    out[7] = limits[3] + size
    out[8] = limits[3] - size


@nb.njit(cache=True, error_model="numpy")
def _fibre(a: Floats, along: Floats) -> float:
    """Return T : S(a), 1 without fibres."""
    found = 0.0
    known = 0.0
    for k in range(6):
        found += along[k] * a[k]
        known += abs(along[k])
    return found if known > 0.0 else 1.0


@nb.njit(cache=True, error_model="numpy")
def _slopes(along: Floats, values: Floats, axes: Floats, out: Floats) -> None:
    for q in range(6):
        i = SYM_ROW[q]
        j = SYM_COLUMN[q]
        size = 0.0
        for k in range(3):
            outer = FROBENIUS[q] * axes[i, k] * axes[j, k]
            out[1 + k, q] = outer
            out[4 + k, q] = -outer
            size += outer / values[k]
        out[0, q] = -along[q]
        out[7, q] = size
        out[8, q] = -size


@nb.njit(cache=True, error_model="numpy")
def _is_below(margins: Floats, least: Floats) -> bool:
    below = False
    for k in range(COUNT):
        below |= margins[k] < least[k]
    return below


@nb.njit(cache=True, error_model="numpy")
def _project(
    a: Floats,
    along: Floats,
    limits: Floats,
    least: Floats,
    further: float,
    values: Floats,
    axes: Floats,
) -> None:
    """Move one muscle's a (6,) onto its bound along the fibres, and then onto those of S(a)."""
    square = 0.0
    for k in range(6):
        square += along[k] * along[k] / FROBENIUS[k]
    over = _fibre(a, along) - (limits[0] - further * least[0])
    if over > 0.0 and square > 0.0:
        for k in range(6):
            a[k] -= over / square * along[k] / FROBENIUS[k]
    _decompose(a, values, axes)
    size = 0.0
    for k in range(3):
        low = limits[1] + further * least[1 + k]
        high = limits[2] - further * least[4 + k]
        values[k] = math.log(min(max(values[k], low), high))
        size += values[k]
    low = further * least[7] - limits[3]
    high = limits[3] - further * least[8]
    shift = (size - min(max(size, low), high)) / 3.0
    for q in range(6):
        a[q] = 0.0
        for k in range(3):
            stretch = math.exp(values[k] - shift)
            a[q] += stretch * axes[SYM_ROW[q], k] * axes[SYM_COLUMN[q], k]
