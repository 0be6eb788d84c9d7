"""The forward problem: minimise E(x; a, b) over the free vertices."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose
from solver.fitting.reference.common import Problem, Reference, finite, solve
from solver.surface import Floats, Ints


def forward(
    face: Face, S: sp.csr_array, pose: Pose, x: Floats, *, tolerance: float = 1e-9
) -> Reference:
    """Minimise E(x; a, b) over the free vertices from ``x`` (p, 3), by IPOPT.

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    problem = ForwardProblem(face, S, pose, x)
    start = x[face.flesh.free].ravel()
    found = solve(problem, start, np.zeros(0), tolerance, 500)
    x = problem.place(found.z)
    return found.checked(Reference(pose, x, found.objective, found.iterations, 0.0))


class ForwardProblem(Problem):
    """Variables are the free vertices' coordinates."""

    def __init__(self, face: Face, S: sp.csr_array, pose: Pose, x: Floats) -> None:
        super().__init__()
        self._flesh = face.flesh
        self._a = face.tet_activations(S, pose.a)
        self._x = x.copy()
        self._x[face.model.mandible] = face.mandible(pose.b)
        pattern = self._flesh.hessian(x, self._a)
        rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        self._keep = np.flatnonzero(pattern.indices <= rows)
        self._structure = rows[self._keep], pattern.indices[self._keep]

    def place(self, z: Floats) -> Floats:
        """Return x (p, 3)."""
        x = self._x.copy()
        x[self._flesh.free] = z.reshape(-1, 3)
        return x

    def objective(self, z: Floats) -> float:
        """See :class:`Problem`."""
        return finite(self._flesh.energy(self.place(z), self._a))

    def gradient(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self._flesh.gradient(self.place(z), self._a)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`Problem`."""
        return self._structure

    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:  # noqa: ARG002
        """See :class:`Problem`."""
        return np.asarray(factor * self._flesh.hessian(self.place(z), self._a).data[self._keep])
