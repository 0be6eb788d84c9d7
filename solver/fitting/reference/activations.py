"""(A) in full space: minimise f over (x, a, b) subject to equilibrium."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser
from solver.fitting.reference.common import Listener, Problem, Reference, solve
from solver.fitting.reference.expression import Expression
from solver.fitting.terms import Term
from solver.surface import Floats, Ints


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
    listen: Listener | None = None,
) -> Reference:
    """Minimise f over (x, a, b) subject to equilibrium, by IPOPT, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    problem = ActivationProblem(face, S, data, regulariser, listen)
    begin = problem.expression.start(start, x)
    found = solve(problem, begin, np.zeros(face.flesh.size), tolerance, max_iterations)
    pose, x = problem.expression.pose(found.z), problem.expression.place(found.z)
    return found.checked(Reference(pose, x, found.objective, found.iterations, found.violation))


class ActivationProblem(Problem):
    """Variables and constraints are those of one expression."""

    def __init__(
        self,
        face: Face,
        S: sp.csr_array,
        data: Term,
        regulariser: Regulariser,
        listen: Listener | None = None,
    ) -> None:
        super().__init__(listen)
        self._S = S
        self.expression = Expression(face, S, data, regulariser)

    def objective(self, z: Floats) -> float:
        """See :class:`Problem`."""
        return self.expression.objective(z)

    def gradient(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self.expression.gradient(z)

    def constraints(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self.expression.constraints(z, self._S)

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`Problem`."""
        return self.expression.jacobian_structure

    def jacobian(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self.expression.jacobian(z, self._S)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`Problem`."""
        return self.expression.hessian_structure

    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:  # noqa: ARG002
        """See :class:`Problem`."""
        return factor * self.expression.hessian(z)
