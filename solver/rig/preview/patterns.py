"""Patterns of contraction: where a muscle's flesh goes as it contracts, by a person's fits.

Fibres say how far a muscle shortens, but not whether it thickens to one side, or shears as it does
under skin. The fits of a rig show it: in expression e muscle j contracts by c_je, and

    log S(a_je) ~ c_je L_j

by least squares over the expressions in which it contracts,

    L_j = dev(sum_e c_je log S(a_je) + ridge K_j) / (sum_e c_je^2 + ridge),

K_j being the pattern of fibres alone (:class:`~solver.fitting.stretches.IsochoricActivations`), and
dev the part that keeps the volume. A muscle that no expression uses has K_j; any other as much of
L_j as lets it contract in full within what muscles can do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.fitting.contraction import STILL, Contraction
from solver.fitting.drives.admissible import ADMISSIBLE, AdmissibleLimits, AdmissibleSet
from solver.fitting.stretches import IsochoricActivations, map_stretches, to_logarithms
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


@dataclass(frozen=True)
class PatternOptions:
    """Trust in fits, and the search for contractions in full."""

    ridge: float = 0.01  # of fibres alone: as much as one expression with a contraction of 0.1
    least: float = STILL.least  # contraction from which an expression counts
    within: AdmissibleLimits = ADMISSIBLE
    flattest: float = 0.05  # stretch that smaller ones count as: free fits go below what is living
    steps: int = 10  # from the learned pattern to that of fibres alone
    longest: float = 3.0  # of patterns, by the contraction that is asked for
    bisections: int = 40


def contract_in_full(
    contraction: Contraction,
    fitted: Floats | Sequence[Floats],
    stretch: float,
    options: PatternOptions = PatternOptions(),
) -> Floats:
    """Return the activations (m, 6) of muscles whose parallel fibres come to ``stretch``.

    ``fitted`` (e, m, 6) are activations of expressions. Muscles without fibres stay at rest.
    """
    kept = np.flatnonzero(np.isfinite(contraction.tensors).all(axis=(1, 2)))
    out = np.tile(IDENTITY, (len(contraction.tensors), 1))
    if not len(kept):
        return out
    own = Contraction(contraction.tensors[kept])
    straight = IsochoricActivations.of(own.tensors)(np.full(len(kept), stretch))
    full = own(straight)
    limits = AdmissibleSet(options.within, own.tensors)
    found = np.reshape([a[kept] for a in fitted], (-1, len(kept), 6))
    by_fibres = to_logarithms(straight, options.flattest) / np.maximum(full, options.least)[:, None]
    learned = _learn(own(found), found, by_fibres, options)
    left = np.ones(len(kept), bool)
    out[kept] = straight
    for part in np.linspace(0.0, 1.0, options.steps, endpoint=False):
        tried, reaches = _reach(own, learned + part * (by_fibres - learned), full, options)
        taken = left & reaches & _is_inside(limits, tried)
        out[kept[taken]] = tried[taken]
        left = left & ~taken
    return out


def _learn(
    contractions: Floats, fitted: Floats, by_fibres: Floats, options: PatternOptions
) -> Floats:
    """Return L (k, 6) of fits (e, k, 6) with ``contractions`` (e, k); ``by_fibres`` are K."""
    used = np.where(contractions > options.least, contractions, 0.0)
    logarithms = np.reshape([to_logarithms(a, options.flattest) for a in fitted], fitted.shape)
    pulled = (used[:, :, None] * logarithms).sum(axis=0) + options.ridge * by_fibres
    pattern = pulled / ((used**2).sum(axis=0) + options.ridge)[:, None]
    trace = pattern @ IDENTITY
    return np.asarray(pattern - trace[:, None] / 3.0 * IDENTITY)


def _reach(
    own: Contraction, patterns: Floats, full: Floats, options: PatternOptions
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return exp(s L) that contract by ``full`` (k,), and which of the patterns L (k, 6) can."""
    low = np.zeros(len(full))
    high = options.longest * full
    for _ in range(options.bisections):
        middle = 0.5 * (low + high)
        short = own(_exponentials(middle[:, None] * patterns)) < full
        low = np.where(short, middle, low)
        high = np.where(short, high, middle)
    reaches = high < options.longest * full
    return _exponentials(high[:, None] * patterns), reaches


def _is_inside(limits: AdmissibleSet, a: Floats, parts: int = 8) -> NDArray[np.bool_]:
    """Tell of which muscles the line from rest to ``a`` (k, 6), which sliders go, is in the set."""
    ways = [IDENTITY + part * (a - IDENTITY) for part in np.linspace(0.0, 1.0, parts + 1)[1:]]
    inside = [(limits.margins(way) > 0.0).all(axis=1) for way in ways]
    return np.asarray(np.all(inside, axis=0))


def _exponentials(entries: Floats) -> Floats:
    return map_stretches(entries, np.exp)
