"""One expression in full space: what the activation and the multi-target problem are made of.

The variables are z = (x of the free vertices, a, b), the constraint is grad_x E(x; a, b, S) = 0,
one row per free coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.fitting.controls import JAW_UNITS, pose_layout
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, Term
from solver.fitting.per_tet import Objective, PerTetOptions
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.reference.common import Data, IpoptProblem, Listener, Reference, finite, solve
from solver.fitting.sensitivity import PoseRates
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
        self._layout = layout = pose_layout(candidates.shape[1] - 1)
        self.count = self.flesh.size + layout.size
        muscles, jaw = (self.flesh.size + layout.places(b.name) for b in layout.blocks)
        self._data = data
        self._by_data = Data(face, data, jaw)
        self._priors = priors
        self._pose_entries = np.nonzero(self._find_touched(candidates))
        pattern = self.flesh.hessian(self.flesh.rest, self.flesh.passive())
        rows = np.repeat(np.arange(self.flesh.size), np.diff(pattern.indptr))
        self.jacobian_structure: tuple[Ints, Ints] = (
            np.concatenate([rows, self._pose_entries[0]]),
            np.concatenate([pattern.indices, self.flesh.size + self._pose_entries[1]]),
        )
        self._block = np.tril_indices(muscles.shape[1])
        by_data = self._by_data.structure
        self.hessian_structure: tuple[Ints, Ints] = (
            np.concatenate([by_data[0], muscles[:, self._block[0]].ravel(), jaw]),
            np.concatenate([by_data[1], muscles[:, self._block[1]].ravel(), jaw]),
        )

    def start(self, pose: Pose, x: Floats) -> Floats:
        """Return z of a pose and x (p, 3)."""
        return np.concatenate([x[self.flesh.free].ravel(), pose.vector()])

    def pose(self, z: Floats) -> Pose:
        """Return a and b."""
        return Pose(*self._layout.split(z[self.flesh.size :]))

    def place(self, z: Floats) -> Floats:
        """Return x (p, 3), the mandible being where b puts it."""
        x = self.face.model.rest.copy()
        x[self.face.model.mandible] = self.face.mandible(self.pose(z).b)
        x[self.flesh.free] = z[: self.flesh.size].reshape(-1, 3)
        return x

    def objective(self, z: Floats) -> float:
        """Return f."""
        return self._data.value(self.place(z)) + self._priors.value(self.pose(z))

    def gradient(self, z: Floats) -> Floats:
        """Return f's derivative, (count,)."""
        pose = self.pose(z)
        by_free, by_jaw = self._by_data.gradient(self.place(z), pose.b)
        by_pose = self._priors.gradient(pose)
        by_pose[self._layout["jaw"]] += by_jaw
        return np.concatenate([by_free, by_pose])

    def hessian(self, z: Floats) -> Floats:
        """Return the entries of f's Gauss-Newton Hessian, lower triangle."""
        pose = self.pose(z)
        blocks, jaw = self._priors.curvature(pose)
        by_data = self._by_data.hessian(self.place(z), pose.b)
        lower = blocks[:, self._block[0], self._block[1]]
        return np.concatenate([by_data, lower.ravel(), jaw])

    def constraints(self, z: Floats, S: sp.csr_array) -> Floats:
        """Return the free coordinates' forces (size,); raises where a tet is inverted."""
        x, a = self.place(z), self.face.with_weights(S).tet_activations(self.pose(z).a)
        finite(self.flesh.energy(x, a))
        return self.flesh.gradient(x, a)

    def jacobian(self, z: Floats, S: sp.csr_array) -> Floats:
        """Return the entries of the constraints' derivative."""
        x, pose, face = self.place(z), self.pose(z), self.face.with_weights(S)
        by_x = self.flesh.hessian(x, face.tet_activations(pose.a)).data
        by_pose = PoseRates.at(face, pose, x).columns()
        return np.concatenate([by_x, by_pose[self._pose_entries]])

    def _find_touched(self, candidates: sp.csr_array) -> Floats:
        """Tell which forces (size,) each entry of (a, b) can change, (size, 6 m + 5)."""
        flesh = self.flesh
        tet, muscle = candidates[:, 1:].nonzero()
        near = np.zeros((len(flesh.free), candidates.shape[1] - 1), dtype=bool)
        jaw = np.zeros(len(flesh.free), dtype=bool)
        rides = np.zeros(len(flesh.rest), dtype=bool)
        rides[self.face.model.mandible] = True
        moved = rides[flesh.tets].any(axis=1)
        for corner in range(4):
            number = flesh.free_numbers[flesh.tets[:, corner]]
            jaw[number[moved & (number >= 0)]] = True
            free = number[tet] >= 0
            near[number[tet][free], muscle[free]] = True
        by_a, by_b = (block.rest for block in self._layout.blocks)
        whole = [np.repeat(near, by_a.shape[1], axis=1), np.tile(jaw[:, None], len(by_b))]
        return np.repeat(np.hstack(whole), 3, axis=0)


# A single expression as IPOPT's problem: what (A) and (P) are.


def minimise(
    expression: Expression,
    start: Pose,
    x: Floats,
    tolerance: float,
    max_iterations: int,
    listen: Listener | None = None,
) -> Reference:
    """Minimise f over one expression's variables, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError`.
    """
    problem = OneExpression(expression, listen)
    begin = expression.start(start, x)
    forces = np.zeros(expression.flesh.size)
    found = solve(problem, begin, forces, tolerance, max_iterations)
    pose, x = expression.pose(found.z), expression.place(found.z)
    return found.check(Reference(pose, x, found.objective, found.iterations, found.violation))


class OneExpression(IpoptProblem):
    """Variables and constraints are those of the expression, S being fixed."""

    def __init__(self, expression: Expression, listen: Listener | None = None) -> None:
        super().__init__(listen)
        self._expression = expression
        self._S = expression.face.S

    def objective(self, z: Floats) -> float:
        """See :class:`IpoptProblem`."""
        return self._expression.objective(z)

    def gradient(self, z: Floats) -> Floats:
        """See :class:`IpoptProblem`."""
        return self._expression.gradient(z)

    def constraints(self, z: Floats) -> Floats:
        """See :class:`IpoptProblem`."""
        return self._expression.constraints(z, self._S)

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`IpoptProblem`."""
        return self._expression.jacobian_structure

    def jacobian(self, z: Floats) -> Floats:
        """See :class:`IpoptProblem`."""
        return self._expression.jacobian(z, self._S)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`IpoptProblem`."""
        return self._expression.hessian_structure

    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:  # noqa: ARG002
        """See :class:`IpoptProblem`."""
        return factor * self._expression.hessian(z)


# (A) in full space: minimise f over (x, a, b) subject to equilibrium.


def activations(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    start: Pose,
    x: Floats,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
    listen: Listener | None = None,
) -> Reference:
    """Minimise f over (x, a, b) subject to equilibrium, by IPOPT, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    expression = Expression(face, face.S, data, MusclePriors(regulariser))
    return minimise(expression, start, x, tolerance, max_iterations, listen)


@dataclass(frozen=True)
class MusclePriors:
    """A regulariser as :class:`~solver.fitting.reference.expression.Priors`."""

    regulariser: Regulariser

    def value(self, pose: Pose) -> float:
        """See :class:`Priors`."""
        return self.regulariser.value(pose)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`Priors`."""
        return self.regulariser.gradient(pose)

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """See :class:`Priors`."""
        whole = self.regulariser.gauss_newton(pose)
        muscles, jaw = pose.layout.places("activations"), pose.layout["jaw"]
        return whole[muscles[:, :, None], muscles[:, None, :]], np.diag(whole)[jaw]


# The forward problem: minimise E(x; a, b) over the free vertices.


def forward(face: Face, pose: Pose, x: Floats, *, tolerance: float = 1e-9) -> Reference:
    """Minimise E(x; a, b) over the free vertices from ``x`` (p, 3), by IPOPT.

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    problem = ForwardProblem(face, pose, x)
    start = x[face.flesh.free].ravel()
    found = solve(problem, start, np.zeros(0), tolerance, 500)
    x = problem.place(found.z)
    return found.check(Reference(pose, x, found.objective, found.iterations, 0.0))


class ForwardProblem(IpoptProblem):
    """Variables are the free vertices' coordinates."""

    def __init__(self, face: Face, pose: Pose, x: Floats) -> None:
        super().__init__()
        self._flesh = face.flesh
        self._a = face.tet_activations(pose.a)
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
        """See :class:`IpoptProblem`."""
        return finite(self._flesh.energy(self.place(z), self._a))

    def gradient(self, z: Floats) -> Floats:
        """See :class:`IpoptProblem`."""
        return self._flesh.gradient(self.place(z), self._a)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`IpoptProblem`."""
        return self._structure

    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:  # noqa: ARG002
        """See :class:`IpoptProblem`."""
        return np.asarray(factor * self._flesh.hessian(self.place(z), self._a).data[self._keep])


# (P) in full space: minimise the per-tet model's f over (x, activations, b), for small meshes.
#
# Every active tet is a muscle by itself (:mod:`solver.fitting.per_tet.tissue`), so the problem is
# (A) with the priors of :mod:`solver.fitting.per_tet`; the contractions gamma_m are the best at
# every iterate.


def per_tet(
    face: Face,
    data: Term,
    options: PerTetOptions | None = None,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
    listen: Listener | None = None,
) -> Reference:
    """Minimise (P) by IPOPT from the resting face; the pose's ``a`` are those of the active tets.

    Raises :class:`InputError` (``model.no_fibres``, ``model.no_muscle``) and
    :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    options = options or PerTetOptions()
    tissue = tissues.of_face(face)
    rest = tissue.face.rest_state()
    priors = TetPriors(Objective(tissue, data, options, rest.pose.b), options.w_b)
    expression = Expression(tissue.face, tissue.face.S, data, priors)
    return minimise(expression, rest.pose, rest.x, tolerance, max_iterations, listen)


@dataclass(frozen=True)
class TetPriors:
    """The per-tet regularisers as :class:`~solver.fitting.reference.expression.Priors`."""

    objective: Objective
    w_b: float

    def value(self, pose: Pose) -> float:
        """See :class:`Priors`."""
        return self.objective.prior_value(pose)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`Priors`."""
        return self.objective.prior_gradient(pose)

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """See :class:`Priors`."""
        return self.objective.prior_blocks(pose.a), self.w_b * JAW_UNITS**2
