"""The reference: the problems as published, in full space, solved by IPOPT.

Slow and trusted. The forward problem minimises E over x; the activation problem minimises f over
(x, a, b) subject to grad_x E(x; a, b) = 0, with exact sparse Jacobians and the Gauss-Newton Hessian
of f (the curvature of the constraint is left out, as in the papers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cyipopt
import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser
from solver.fitting.sensitivity import coordinates, gradient_by_pose
from solver.fitting.terms import Term
from solver.surface import Floats, Ints

SUCCESS = (0, 1)
"""IPOPT's Solve_Succeeded and Solved_To_Acceptable_Level."""


@dataclass(frozen=True)
class Reference:
    """IPOPT's answer: pose, x (p, 3), objective, iterations, and the constraint's violation."""

    pose: Pose
    x: Floats
    objective: float
    iterations: int
    violation: float


def forward(
    face: Face, S: sp.csr_array, pose: Pose, x: Floats, *, tolerance: float = 1e-9
) -> Reference:
    """Minimise E(x; a, b) over the free vertices from ``x`` (p, 3), by IPOPT.

    Raises :class:`SolveError` (``ipopt.failed``) with IPOPT's message.
    """
    problem = _Forward(face, S, pose, x)
    solution, info = _solve(problem, x[face.flesh.free].ravel(), 0, tolerance, 500)
    return Reference(pose, problem.place(solution), info["obj_val"], problem.iterations, 0.0)


def activations(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    start: Pose,
    x: Floats,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
) -> Reference:
    """Minimise f over (x, a, b) subject to equilibrium, by IPOPT, from ``start`` and ``x`` (p, 3).

    Raises :class:`SolveError` (``ipopt.failed``) with IPOPT's message.
    """
    problem = _Activations(face, S, data, regulariser)
    begin = np.concatenate([x[face.flesh.free].ravel(), start.a.ravel(), start.b])
    solution, info = _solve(problem, begin, face.flesh.size, tolerance, max_iterations)
    pose = problem.pose(solution)
    violation = float(np.abs(info["g"]).max())
    x = problem.place(solution)
    return Reference(pose, x, info["obj_val"], problem.iterations, violation)


def _solve(
    problem: Any, start: Floats, constraints: int, tolerance: float, max_iterations: int
) -> tuple[Floats, dict[str, Any]]:
    ipopt = cyipopt.Problem(
        n=len(start),
        m=constraints,
        problem_obj=problem,
        cl=np.zeros(constraints),
        cu=np.zeros(constraints),
    )
    ipopt.add_option("sb", "yes")
    ipopt.add_option("print_level", 0)
    ipopt.add_option("tol", tolerance)
    ipopt.add_option("max_iter", max_iterations)
    solution, info = ipopt.solve(start)
    if info["status"] not in SUCCESS:
        message = info["status_msg"]
        text = message.decode() if isinstance(message, bytes) else str(message)
        raise SolveError("ipopt.failed", f"IPOPT: {text}", iterations=problem.iterations)
    return solution, info


class _Counting:
    """What both problems share: IPOPT's iteration count, and the flesh."""

    def __init__(self, face: Face, S: sp.csr_array) -> None:
        self.face = face
        self.flesh = face.flesh
        self.S = S
        self.iterations = 0

    def intermediate(self, _mode: int, iteration: int, *_rest: float) -> bool:
        """Take IPOPT's report of an iteration."""
        self.iterations = iteration
        return True

    def _finite(self, value: float) -> float:
        if not np.isfinite(value):
            raise cyipopt.CyIpoptEvaluationError
        return value


class _Forward(_Counting):
    def __init__(self, face: Face, S: sp.csr_array, pose: Pose, x: Floats) -> None:
        super().__init__(face, S)
        self._a = face.tet_activations(S, pose.a)
        self._x = x.copy()
        self._x[face.model.mandible] = face.mandible(pose.b)
        pattern = self.flesh.hessian(x, self._a)
        rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        self._keep = np.flatnonzero(pattern.indices <= rows)
        self._structure = rows[self._keep], pattern.indices[self._keep]

    def place(self, z: Floats) -> Floats:
        x = self._x.copy()
        x[self.flesh.free] = z.reshape(-1, 3)
        return x

    def objective(self, z: Floats) -> float:
        return self._finite(self.flesh.energy(self.place(z), self._a))

    def gradient(self, z: Floats) -> Floats:
        return self.flesh.gradient(self.place(z), self._a)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        return self._structure

    def hessian(self, z: Floats, _multipliers: Floats, factor: float) -> Floats:
        return np.asarray(factor * self.flesh.hessian(self.place(z), self._a).data[self._keep])


class _Activations(_Counting):
    """Variables z = (x of the free vertices, a, b); one constraint per free coordinate."""

    def __init__(self, face: Face, S: sp.csr_array, data: Term, regulariser: Regulariser) -> None:
        super().__init__(face, S)
        self._data = data
        self._regulariser = regulariser
        self._free = coordinates(face.flesh.free)
        curvature = data.curvature(face.model.rest)
        self._by_free = curvature[self._free][:, self._free]
        self._jacobian_structure()
        self._hessian_structure()

    def place(self, z: Floats) -> Floats:
        x = self.face.model.rest.copy()
        x[self.face.model.mandible] = self.face.mandible(self.pose(z).b)
        x[self.flesh.free] = z[: self.flesh.size].reshape(-1, 3)
        return x

    def pose(self, z: Floats) -> Pose:
        return Pose(z[self.flesh.size : -5].reshape(-1, 6), z[-5:])

    def objective(self, z: Floats) -> float:
        return self._data.value(self.place(z)) + self._regulariser.value(self.pose(z))

    def gradient(self, z: Floats) -> Floats:
        pose = self.pose(z)
        by_x = self._data.gradient(self.place(z)).ravel()
        by_pose = self._regulariser.gradient(pose)
        by_pose[-5:] += self._jaw_motion(pose).T @ by_x
        return np.concatenate([by_x[self._free], by_pose])

    def constraints(self, z: Floats) -> Floats:
        x, a = self.place(z), self._tet_a(z)
        self._finite(self.flesh.energy(x, a))
        return self.flesh.gradient(x, a)

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        return self._jacobian_rows, self._jacobian_columns

    def jacobian(self, z: Floats) -> Floats:
        x = self.place(z)
        by_pose = gradient_by_pose(self.face, self.S, self.pose(z), x)
        rows, columns = self._pose_entries
        by_x = self.flesh.hessian(x, self._tet_a(z)).data
        return np.concatenate([by_x, by_pose[rows, columns]])

    def hessianstructure(self) -> tuple[Ints, Ints]:
        return self._hessian_rows, self._hessian_columns

    def hessian(self, z: Floats, _multipliers: Floats, factor: float) -> Floats:
        pose = self.pose(z)
        curvature = self._data.curvature(self.place(z))
        motion = self._jaw_motion(pose)
        pull = curvature @ motion
        by_pose = self._regulariser.gauss_newton(pose)
        by_pose[-5:, -5:] += motion.T @ pull
        by_free = curvature[self._free][:, self._free]
        cross = pull[self._free].T
        values = [by_free.data[self._free_keep], cross.ravel(), by_pose[self._pose_lower]]
        return factor * np.concatenate(values)

    def _tet_a(self, z: Floats) -> Floats:
        return self.face.tet_activations(self.S, self.pose(z).a)

    def _jaw_motion(self, pose: Pose) -> Floats:
        """Return dx/db of what moves with the mandible, (3 p, 5)."""
        direct = self.face.mandible_jacobian(pose.b)
        return direct.reshape(-1, direct.shape[2])

    def _jacobian_structure(self) -> None:
        """Find the constraint Jacobian's entries: H, then the nonzero ones by a, then all by b."""
        flesh = self.flesh
        pattern = flesh.hessian(flesh.rest, flesh.passive())
        rows = np.repeat(np.arange(flesh.size), np.diff(pattern.indptr))
        active = sp.csr_array(
            ((self.S.data != 0).astype(float), self.S.indices, self.S.indptr), shape=self.S.shape
        )
        tet, muscle = active[:, 1:].nonzero()
        vertex = flesh.free_numbers[flesh.tets[tet]]
        near = np.zeros((len(flesh.free), self.face.model.muscle_count), dtype=bool)
        for corner in range(4):
            free = vertex[:, corner] >= 0
            near[vertex[free, corner], muscle[free]] = True
        by_pose = np.ones((flesh.size, 6 * near.shape[1] + 5), dtype=bool)
        by_pose[:, :-5] = np.repeat(np.repeat(near, 3, axis=0), 6, axis=1)
        self._pose_entries = np.nonzero(by_pose)
        self._jacobian_rows = np.concatenate([rows, self._pose_entries[0]])
        self._jacobian_columns = np.concatenate(
            [pattern.indices, flesh.size + self._pose_entries[1]]
        )

    def _hessian_structure(self) -> None:
        """Find the lower triangle's entries: by x, the rows of b by x, then by (a, b)."""
        size, poses = self.flesh.size, 6 * self.face.model.muscle_count + 5
        rows = np.repeat(np.arange(size), np.diff(self._by_free.indptr))
        self._free_keep = np.flatnonzero(self._by_free.indices <= rows)
        self._pose_lower = np.tril_indices(poses)
        cross_rows, cross_columns = np.indices((5, size))
        self._hessian_rows = np.concatenate(
            [
                rows[self._free_keep],
                (size + poses - 5 + cross_rows).ravel(),
                size + self._pose_lower[0],
            ]
        )
        self._hessian_columns = np.concatenate(
            [
                self._by_free.indices[self._free_keep],
                cross_columns.ravel(),
                size + self._pose_lower[1],
            ]
        )
