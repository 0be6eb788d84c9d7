"""Linear blending of poses, as published for blendshape-driven animation (Phace, SIGGRAPH 2017).

    a(w) = a_I + sum_e w_e (a_e - a_I),    b(w) = sum_e w_e b_e

a_e and b_e are the activations and the jaw of an expression, solved once, a_I those of rest. Where
expressions add up, a muscle may come out so short that its S(a) folds its flesh: its eigenvalues
are kept from falling below what fits keep to. A weight below 0 or above 1 counts as that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from solver.fitting.face import Pose
from solver.fitting.objective import LEAST_STRETCH
from solver.fitting.stretches import COLUMN, ROW, matrices
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


@dataclass(frozen=True)
class Blend:
    """Expressions ``names``: ``activations`` (e, m, 6) and ``jaw`` (e, 5)."""

    names: tuple[str, ...]
    activations: Floats
    jaw: Floats

    @classmethod
    def of(cls, poses: Mapping[str, Pose], muscles: int) -> Blend:
        """Return the blend of named poses of so many muscles."""
        a = np.array([pose.a for pose in poses.values()]).reshape(-1, muscles, 6)
        b = np.array([pose.b for pose in poses.values()]).reshape(-1, 5)
        return cls(tuple(poses), a, b)

    def pose(self, weights: Floats) -> Pose:
        """Return the blend by ``weights`` (e,), which may still fold muscles."""
        share = np.clip(weights, 0.0, 1.0)
        a = IDENTITY + np.tensordot(share, self.activations - IDENTITY, 1)
        return Pose(np.asarray(a), np.asarray(share @ self.jaw))


def unfolded(a: Floats) -> tuple[Floats, int]:
    """Return activations (m, 6) with every eigenvalue at least what fits keep to, and the changed.

    The second value counts the muscles that had a smaller one.
    """
    values, axes = np.linalg.eigh(matrices(a))
    folded = np.flatnonzero(values[:, 0] < LEAST_STRETCH)
    kept = np.maximum(values[folded], LEAST_STRETCH)
    whole = (axes[folded] * kept[:, None]) @ axes[folded].transpose(0, 2, 1)
    result = a.copy()
    result[folded] = whole[:, ROW, COLUMN]
    return result, len(folded)
