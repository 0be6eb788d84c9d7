"""One expression in full space: what the activation and the multi-target problem are made of.

The variables are z = (x of the free vertices, a, b), the constraint is grad_x E(x; a, b, S) = 0,
one row per free coordinate.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose
from solver.fitting.reference.common import Data, finite
from solver.fitting.sensitivity import gradient_by_pose
from solver.fitting.terms import Term
from solver.surface import Floats, Ints


class Priors(Protocol):
    """The part of f that depends on the pose alone."""

    def value(self, pose: Pose) -> float:
        """Return it."""

    def gradient(self, pose: Pose) -> Floats:
        """Return its derivative by (a, b), (6 m + 5,)."""

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return its Hessian: a block of each muscle, (m, 6, 6), and b's diagonal (5,)."""


class Expression:
    """Values and derivatives by z (``count``,); S may change but not its candidates.

    ``candidates`` (n, m + 1) has an entry for each muscle that can move a tet.
    """

    def __init__(self, face: Face, candidates: sp.csr_array, data: Term, priors: Priors) -> None:
        self.face = face
        self.flesh = face.flesh
        self._muscles = candidates.shape[1] - 1
        self.count = self.flesh.size + 6 * self._muscles + 5
        self._data = data
        self._by_data = Data(face, data, self.count - 5)
        self._priors = priors
        self._pose_entries = np.nonzero(self._touched(candidates))
        pattern = self.flesh.hessian(self.flesh.rest, self.flesh.passive())
        rows = np.repeat(np.arange(self.flesh.size), np.diff(pattern.indptr))
        self.jacobian_structure: tuple[Ints, Ints] = (
            np.concatenate([rows, self._pose_entries[0]]),
            np.concatenate([pattern.indices, self.flesh.size + self._pose_entries[1]]),
        )
        self._block = np.tril_indices(6)
        first = self.flesh.size + 6 * np.arange(self._muscles)[:, None]
        by_data, jaw = self._by_data.structure, np.arange(self.count - 5, self.count)
        self.hessian_structure: tuple[Ints, Ints] = (
            np.concatenate([by_data[0], (first + self._block[0]).ravel(), jaw]),
            np.concatenate([by_data[1], (first + self._block[1]).ravel(), jaw]),
        )

    def start(self, pose: Pose, x: Floats) -> Floats:
        """Return z of a pose and x (p, 3)."""
        return np.concatenate([x[self.flesh.free].ravel(), pose.a.ravel(), pose.b])

    def pose(self, z: Floats) -> Pose:
        """Return a and b."""
        return Pose(z[self.flesh.size : -5].reshape(-1, 6), z[-5:])

    def place(self, z: Floats) -> Floats:
        """Return x (p, 3), the mandible being where b puts it."""
        x = self.face.model.rest.copy()
        x[self.face.model.mandible] = self.face.mandible(z[-5:])
        x[self.flesh.free] = z[: self.flesh.size].reshape(-1, 3)
        return x

    def objective(self, z: Floats) -> float:
        """Return f."""
        return self._data.value(self.place(z)) + self._priors.value(self.pose(z))

    def gradient(self, z: Floats) -> Floats:
        """Return f's derivative, (count,)."""
        by_free, by_jaw = self._by_data.gradient(self.place(z), z[-5:])
        by_pose = self._priors.gradient(self.pose(z))
        by_pose[-5:] += by_jaw
        return np.concatenate([by_free, by_pose])

    def hessian(self, z: Floats) -> Floats:
        """Return the entries of f's Gauss-Newton Hessian, lower triangle."""
        blocks, jaw = self._priors.curvature(self.pose(z))
        by_data = self._by_data.hessian(self.place(z), z[-5:])
        lower = blocks[:, self._block[0], self._block[1]]
        return np.concatenate([by_data, lower.ravel(), jaw])

    def constraints(self, z: Floats, S: sp.csr_array) -> Floats:
        """Return the free coordinates' forces (size,); raises where a tet is inverted."""
        x, a = self.place(z), self.face.tet_activations(S, self.pose(z).a)
        finite(self.flesh.energy(x, a))
        return self.flesh.gradient(x, a)

    def jacobian(self, z: Floats, S: sp.csr_array) -> Floats:
        """Return the entries of the constraints' derivative."""
        x, pose = self.place(z), self.pose(z)
        by_x = self.flesh.hessian(x, self.face.tet_activations(S, pose.a)).data
        by_pose = gradient_by_pose(self.face, S, pose, x)
        return np.concatenate([by_x, by_pose[self._pose_entries]])

    def _touched(self, candidates: sp.csr_array) -> Floats:
        """Tell which forces (size,) each entry of (a, b) can change, (size, 6 m + 5)."""
        flesh = self.flesh
        tet, muscle = candidates[:, 1:].nonzero()
        near = np.zeros((len(flesh.free), self._muscles), dtype=bool)
        jaw = np.zeros(len(flesh.free), dtype=bool)
        rides = np.zeros(len(flesh.rest), dtype=bool)
        rides[self.face.model.mandible] = True
        moved = rides[flesh.tets].any(axis=1)
        for corner in range(4):
            number = flesh.free_numbers[flesh.tets[:, corner]]
            jaw[number[moved & (number >= 0)]] = True
            free = number[tet] >= 0
            near[number[tet][free], muscle[free]] = True
        return np.repeat(np.hstack([np.repeat(near, 6, axis=1), np.tile(jaw[:, None], 5)]), 3, 0)
