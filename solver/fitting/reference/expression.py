"""One expression in full space: what the activation and the multi-target problem are made of.

The variables are z = (x of the free vertices, a, b), the constraint is grad_x E(x; a, b, S) = 0,
one row per free coordinate.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol, Self

import cyipopt
import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import Finding, SolveError, make_warning
from solver.fitting.controls import Block, Layout
from solver.fitting.face import Face, Pose
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Regulariser, Term, sparse
from solver.fitting.per_tet import PER_TET, PerTetOptions, PerTetPriors
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.sensitivity import PoseRates, coordinates
from solver.surface import Floats, Ints

# Common to IPOPT's problems: the call of IPOPT, and its answers.


SUCCESS = (0, 1)  # IPOPT's Solve_Succeeded and Solved_To_Acceptable_Level
UNBOUNDED = 2e19  # IPOPT's infinity


@dataclass(frozen=True)
class Solution:
    """IPOPT's answer: f, iterations, the constraints' violation, and the trouble if it is none."""

    objective: float
    iterations: int
    violation: float
    trouble: str | None

    def check(self) -> Self:
        """Return this; raise :class:`NotConvergedError` where IPOPT stopped early."""
        if self.trouble is not None:
            raise NotConvergedError(self.trouble, self)
        return self


@dataclass(frozen=True)
class ReferenceSolution(Solution):
    """IPOPT's answer for one expression: its ``pose`` and ``x`` (p, 3)."""

    pose: Pose
    x: Floats


class NotConvergedError(SolveError):
    """IPOPT stopped early; ``last`` is where, in the form of the answer."""

    def __init__(self, trouble: str, last: Any) -> None:
        text = f"IPOPT stopped after {last.iterations} iterations: {trouble}"
        super().__init__("ipopt.failed", text, iterations=last.iterations)
        self.last = last

    def notice(self, kept: str) -> Finding:
        """Return the failure as a notice; ``kept`` says what is kept instead."""
        return make_warning(self.code, f"{self.message}; {kept}", self.context)


class IpoptProblem(ABC):
    """A problem in cyipopt's form: minimise the objective under constraints, z (n,) being free.

    Where there are constraints it has ``constraints`` (z), ``jacobianstructure`` () and
    ``jacobian`` (z) as well.
    """

    def __init__(self, listen: Listener | None = None) -> None:
        self.iterations = 0
        self._listen = listen

    def intermediate(self, _mode: int, iteration: int, objective: float, *_rest: float) -> bool:
        """Take IPOPT's report of an iteration."""
        self.iterations = iteration
        if self._listen:
            self._listen(iteration, objective)
        return True

    @abstractmethod
    def objective(self, z: Floats) -> float:
        """Return f."""

    @abstractmethod
    def gradient(self, z: Floats) -> Floats:
        """Return f's derivative (n,)."""

    @abstractmethod
    def hessianstructure(self) -> tuple[Ints, Ints]:
        """Return rows and columns of the Hessian's lower triangle; repeated entries are summed."""

    @abstractmethod
    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:
        """Return the entries of ``factor`` times the objective's Gauss-Newton Hessian."""


def solve(
    problem: IpoptProblem,
    start: Floats,
    constants: Floats,
    tolerance: float,
    max_iterations: int,
    lower: Floats | float = -UNBOUNDED,
    upper: Floats | float = UNBOUNDED,
) -> tuple[Floats, Solution]:
    """Run IPOPT from ``start`` (n,), the constraints (m,) being equal to ``constants``.

    ``lower`` and ``upper`` (n,) bound the variables. Returns those that it ended with, too.
    """
    ipopt = cyipopt.Problem(
        n=len(start),
        m=len(constants),
        problem_obj=problem,
        lb=np.maximum(np.full(len(start), -UNBOUNDED), lower),
        ub=np.minimum(np.full(len(start), UNBOUNDED), upper),
        cl=constants,
        cu=constants,
    )
    options = {"sb": "yes", "print_level": 0, "tol": tolerance, "max_iter": max_iterations}
    for name, value in options.items():
        ipopt.add_option(name, value)
    z, info = ipopt.solve(start)
    violation = float(np.abs(info["g"] - constants).max(initial=0.0))
    trouble = None if info["status"] in SUCCESS else info["status_msg"].decode()
    found = Solution(float(info["obj_val"]), problem.iterations, violation, trouble)
    return np.asarray(z), found


def finite(value: float) -> float:
    """Return the value; tell IPOPT to step back where a tet is inverted."""
    if not np.isfinite(value):
        raise cyipopt.CyIpoptEvaluationError
    return value


class Priors(Protocol):
    """The part of f that depends on the pose alone."""

    def value(self, pose: Pose) -> float:
        """Return it."""

    def gradient(self, pose: Pose) -> Floats:
        """Return its derivative by (a, b), (6 m + 5,)."""

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return its Hessian: a block of each muscle, (m, 6, 6), and b's diagonal (5,)."""


class ExpressionProblem(IpoptProblem):
    """The problem in z, laid out in ``layout``; S may change but not its ``candidates``.

    ``candidates`` (n, m + 1) has an entry for each muscle that can move a tet: S if not given.
    """

    def __init__(
        self,
        face: Face,
        data: Term,
        priors: Priors,
        candidates: sp.csr_array | None = None,
        listen: Listener | None = None,
    ) -> None:
        super().__init__(listen)
        self.face = face
        self.flesh = flesh = face.flesh
        self.layout = Layout((Block("x", flesh.rest[flesh.free]), *face.layout.blocks))
        muscles = self.layout.muscles
        jaw = self.layout.joint_places
        self._columns = muscles.shape[1], len(jaw)
        self._data = data
        self._priors = priors
        self._pose_entries = self._find_touched(face.S if candidates is None else candidates)
        pattern = flesh.hessian(flesh.rest, flesh.passive())
        rows = np.repeat(np.arange(flesh.size), np.diff(pattern.indptr))
        self._jacobian_structure: tuple[Ints, Ints] = (
            np.concatenate([rows, self._pose_entries[0]]),
            np.concatenate([pattern.indices, flesh.size + self._pose_entries[1]]),
        )
        self._block = np.tril_indices(muscles.shape[1])
        # the pattern at rest: what is curved elsewhere only, as contact is, has its gradient alone,
        # which slows IPOPT but moves no minimum
        touched = sparse(data.curvature(flesh.rest)).copy()
        touched.data[:] = 1.0
        ones = self._motion(np.ones((3 * len(face.model.mandible), len(jaw))))
        curved_rows, curved_columns = sp.tril(ones.T @ touched @ ones).coords
        self._curved = curved_rows, curved_columns
        self._hessian_structure: tuple[Ints, Ints] = (
            np.concatenate([curved_rows, muscles[:, self._block[0]].ravel(), jaw]),
            np.concatenate([curved_columns, muscles[:, self._block[1]].ravel(), jaw]),
        )

    def minimise(
        self, start: Pose, x: Floats, tolerance: float = 1e-7, max_iterations: int = 1000
    ) -> ReferenceSolution:
        """Minimise f from ``start`` and ``x`` (p, 3); raises :class:`NotConvergedError`."""
        forces = np.zeros(self.flesh.size)
        bounds = self.layout.lower, self.layout.upper
        z, found = solve(self, self.start(start, x), forces, tolerance, max_iterations, *bounds)
        return ReferenceSolution(pose=self.pose(z), x=self.place(z), **vars(found)).check()

    def start(self, pose: Pose, x: Floats) -> Floats:
        """Return z of a pose and x (p, 3)."""
        return self.layout.join([x[self.flesh.free], pose.a, pose.b])

    def pose(self, z: Floats) -> Pose:
        """Return a and b."""
        return Pose.of(self.face.layout, z[self.flesh.size :])

    def place(self, z: Floats) -> Floats:
        """Return x (p, 3), the mandible being where b puts it."""
        x = self.face.model.rest.copy()
        x[self.face.model.mandible] = self.face.mandible(self.pose(z).b)
        x[self.flesh.free] = self.layout.part("x", z)
        return x

    @override
    def objective(self, z: Floats) -> float:
        return self._data.value(self.place(z)) + self._priors.value(self.pose(z))

    @override
    def gradient(self, z: Floats) -> Floats:
        pose = self.pose(z)
        out = self._motion_at(pose).T @ self._data.gradient(self.place(z)).ravel()
        out[self.flesh.size :] += self._priors.gradient(pose)
        return np.asarray(out)

    @override
    def hessianstructure(self) -> tuple[Ints, Ints]:
        return self._hessian_structure

    @override
    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:
        pose = self.pose(z)
        blocks, jaw = self._priors.curvature(pose)
        motion = self._motion_at(pose)
        whole = motion.T @ sparse(self._data.curvature(self.place(z))) @ motion
        by_data = np.asarray(sp.csr_array(whole)[self._curved]).ravel()
        lower = blocks[:, self._block[0], self._block[1]]
        return factor * np.concatenate([by_data, lower.ravel(), jaw])

    def constraints(self, z: Floats, S: sp.csr_array | None = None) -> Floats:
        """Return the free coordinates' forces (size,); tells IPOPT where a tet is inverted."""
        face = self.face if S is None else self.face.with_unchecked_weights(S)
        x = self.place(z)
        a = face.flesh_controls(self.pose(z).a)
        finite(self.flesh.energy(x, a))
        return self.flesh.gradient(x, a)

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        """Return rows and columns of the constraints' derivative."""
        return self._jacobian_structure

    def jacobian(self, z: Floats, S: sp.csr_array | None = None) -> Floats:
        """Return its entries."""
        face = self.face if S is None else self.face.with_unchecked_weights(S)
        x = self.place(z)
        pose = self.pose(z)
        by_x = self.flesh.hessian(x, face.flesh_controls(pose.a)).data
        by_pose = PoseRates(face, face.tet_forces(pose, x), pose).columns()
        return np.concatenate([by_x, by_pose[self._pose_entries]])

    def _motion_at(self, pose: Pose) -> sp.csr_array:
        mandible = self.face.model.mandible
        rates = self.face.mandible_jacobian(pose.b)[mandible]
        return self._motion(rates.reshape(3 * len(mandible), -1))

    def _motion(self, by_jaw: Floats) -> sp.csr_array:
        """Return dx/dz (3 p, n) with ``by_jaw`` (k, 5) the mandible's coordinates by b."""
        free = self.flesh.free_coordinates
        riding = coordinates(self.face.model.mandible)
        rows = np.concatenate([free, np.repeat(riding, by_jaw.shape[1])])
        jaw = np.arange(self.layout.size)[-by_jaw.shape[1] :]
        columns = [np.arange(len(free)), np.tile(jaw, len(riding))]
        values = np.concatenate([np.ones(len(free)), by_jaw.ravel()])
        shape = self.flesh.rest.size, self.layout.size
        return sp.csr_array((values, (rows, np.concatenate(columns))), shape=shape)

    def _find_touched(self, candidates: sp.csr_array) -> tuple[Ints, Ints]:
        """Return the pairs of a force (size,) and an entry of (a, b) that can change it."""
        flesh = self.flesh
        numbers = flesh.free_numbers[flesh.tets]
        tet, corner = np.nonzero(numbers >= 0)
        shape = len(flesh.free), len(flesh.tets)
        joins = sp.csr_array((np.ones(len(tet)), (numbers[tet, corner], tet)), shape=shape)
        rides = np.isin(flesh.tets, self.face.model.mandible).any(axis=1)
        near = (joins @ (candidates[:, 1:] != 0).astype(float)).toarray() > 0.0
        near = np.repeat(near, self._columns[0], axis=1)
        jaw = np.tile((joins @ rides > 0.0)[:, None], self._columns[1])
        force, entry = np.nonzero(np.repeat(np.hstack([near, jaw]), 3, axis=0))
        return force, entry


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
) -> ReferenceSolution:
    """Solve (A): minimise f over (x, a, b) subject to equilibrium, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    expression = ExpressionProblem(face, data, regulariser, listen=listen)
    return expression.minimise(start, x, tolerance, max_iterations)


def per_tet(face: Face, data: Term, options: PerTetOptions = PER_TET) -> ReferenceSolution:
    """Solve (P) from the resting face; the pose's ``a`` are those of the active tets.

    Every active tet is a muscle by itself (:mod:`solver.fitting.per_tet.tissue`), so this is (A)
    with other priors; the contractions gamma_m are the best at every iterate. For small meshes.
    Raises :class:`InputError` (``model.no_fibres``, ``model.no_muscle``) and
    :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    tissue = tissues.of_face(face)
    rest = tissue.face.rest
    priors = PerTetPriors(tissue, options, rest.pose.b)
    return ExpressionProblem(tissue.face, data, priors).minimise(rest.pose, rest.x)


class _Forward(IpoptProblem):
    """E(x; a, b) over the free vertices' coordinates."""

    def __init__(self, face: Face, pose: Pose, x: Floats) -> None:
        super().__init__()
        self._flesh = face.flesh
        self._a = face.flesh_controls(pose.a)
        self._x = x.copy()
        self._x[face.model.mandible] = face.mandible(pose.b)
        pattern = self._flesh.hessian(x, self._a)
        rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        self._keep = np.flatnonzero(pattern.indices <= rows)
        self._structure = rows[self._keep], pattern.indices[self._keep]

    def place(self, z: Floats) -> Floats:
        x = self._x.copy()
        x[self._flesh.free] = z.reshape(-1, 3)
        return x

    @override
    def objective(self, z: Floats) -> float:
        return finite(self._flesh.energy(self.place(z), self._a))

    @override
    def gradient(self, z: Floats) -> Floats:
        return self._flesh.gradient(self.place(z), self._a)

    @override
    def hessianstructure(self) -> tuple[Ints, Ints]:
        return self._structure

    @override
    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:
        return np.asarray(factor * self._flesh.hessian(self.place(z), self._a).data[self._keep])


def forward(face: Face, pose: Pose, x: Floats, *, tolerance: float = 1e-9) -> ReferenceSolution:
    """Minimise E(x; a, b) over x (p, 3) of the free vertices; raises as :func:`activations`."""
    problem = _Forward(face, pose, x)
    z, found = solve(problem, x[face.flesh.free].ravel(), np.zeros(0), tolerance, 500)
    return ReferenceSolution(pose=pose, x=problem.place(z), **vars(found)).check()
