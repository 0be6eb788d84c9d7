"""The measure in which changes of controls are learned: the skin's mean square motion at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.fitting.activation import rest_curvature
from solver.fitting.face import Face, Pose
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats

# mm^2 of mean square skin motion that a unit of any control counts for besides what it moves, so
# that muscles which nobody sees are learned as well
UNSEEN = 1e-4


def changes_of(activations: Floats, jaw: Floats) -> Floats:
    """Return the changes (..., 6 m + 5) off the rest of activations (..., m, 6) and a free jaw."""
    changes = (activations - IDENTITY).reshape(*jaw.shape[:-1], -1)
    return np.concatenate([changes, jaw], axis=-1)


def pose_of(changes: NDArray[np.floating]) -> Pose:
    """Return activations and a free jaw of changes (6 m + 5,) off the rest."""
    moved = np.asarray(changes, float)
    return Pose(IDENTITY + moved[:-5].reshape(-1, 6), moved[-5:])


@dataclass(frozen=True, eq=False)
class Metric:
    """G = L L^T of changes p (k,) of controls: p . G p is mm^2 on the skin; ``root`` is L (k, k).

    z = L^T p has the same length in the plain measure.
    """

    root: Floats

    @classmethod
    def of_face(cls, face: Face, unseen: float = UNSEEN) -> Metric:
        """Return J^T J of the face's points at rest, for activations and a free jaw."""
        curvature = rest_curvature(face.with_free_jaw()) / 2.0
        root = np.linalg.cholesky(curvature + unseen * np.eye(len(curvature)))
        return cls(np.asarray(root, float))

    def main_directions(self, changes: Floats, count: int) -> MainDirections:
        """Return the main directions of ``changes`` (n, k), at most ``count``."""
        z = changes @ self.root
        values, vectors = np.linalg.eigh(z.T @ z)
        main = np.flatnonzero(values > 1e-12 * values[-1])[-count:][::-1]
        along = scipy.linalg.solve_triangular(self.root, vectors[:, main], lower=True, trans="T")
        return MainDirections(z @ vectors[:, main], np.asarray(along.T, np.float32))


@dataclass(frozen=True, eq=False)
class MainDirections:
    """Coordinates (n, a) of changes in ``directions`` (a, k), in mm on the skin."""

    coordinates: Floats
    directions: NDArray[np.float32]
