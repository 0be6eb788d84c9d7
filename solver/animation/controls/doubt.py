"""How far off a face may be, by how far two maps that were learned apart disagree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats

SURE = 0.9  # part of unseen mixtures that are no further off than their doubt says
LEAST = 1e-6  # mm


@dataclass(frozen=True)
class Doubt:
    """doubt = scale d^power mm of a disagreement d in mm, both fitted to unseen mixtures."""

    scale: float
    power: float

    @classmethod
    def calibrate(cls, disagreements: Floats, errors: Floats, sure: float = SURE) -> Doubt:
        """Fit errors (n,) by disagreements (n,), in logarithms; most are no greater then."""
        x, y = (np.log(np.maximum(each, LEAST)) for each in (disagreements, errors))
        spread = float(np.var(x))
        power = float(np.cov(x, y, bias=True)[0, 1] / spread) if spread else 0.0
        power = min(max(power, 0.0), 2.0)
        return cls(float(np.exp(np.quantile(y - power * x, sure))), power)

    def of(self, disagreements: Floats) -> Floats:
        """Return the doubt (...,) in mm."""
        return np.asarray(self.scale * np.maximum(disagreements, LEAST) ** self.power)


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
