"""Doubt of learned controls: how far off a face may be where two maps disagree, or none follows.

Mixtures that the muscles cannot make well are those in which an exact solve jumps most, and are
known worst.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats

SURE = 0.96  # part of unseen mixtures that are no further off than their doubt says
LEAST = 1e-4  # mm


@dataclass(frozen=True)
class Doubt:
    """doubt = scale d^apart o^target mm, fitted to unseen mixtures.

    d mm is how far two maps disagree, o mm how far an exact solve is off the mixture's own skin,
    as the maps have learned it.
    """

    scale: float
    apart: float
    target: float

    @classmethod
    def calibrate(cls, apart: Floats, target: Floats, errors: Floats, sure: float = SURE) -> Doubt:
        """Fit errors (n,) mm by d (n,) and o (n,), in logarithms; most are no greater then."""
        logs = np.log(np.maximum([apart, target], LEAST)).T
        known = np.column_stack([logs, np.ones(len(logs))])
        y = np.log(np.maximum(errors, LEAST))
        powers = np.maximum(np.linalg.lstsq(known, y, rcond=None)[0][:2], 0.0)
        scale = np.exp(np.quantile(y - logs @ powers, sure))
        return cls(float(scale), *(float(power) for power in powers))

    def of(self, apart: Floats, target: Floats) -> Floats:
        """Return the doubt (...,) in mm."""
        d = np.maximum(apart, LEAST)
        o = np.maximum(target, LEAST)
        return np.asarray(self.scale * d**self.apart * o**self.target)


def discrimination(scores: Floats, wrong: np.ndarray) -> float | None:
    """Return the area under the receiver operating characteristic of ``scores`` (n,).

    It is the chance that one that is ``wrong`` scores higher than one that is not; None where all
    are of one sort.
    """
    right = len(wrong) - int(wrong.sum())
    if not right or not wrong.any():
        return None
    ranks = np.argsort(np.argsort(scores)) + 1.0
    count = len(wrong) - right
    return float((ranks[wrong].sum() - count * (count + 1) / 2.0) / (count * right))
