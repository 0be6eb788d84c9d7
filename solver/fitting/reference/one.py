"""A single expression as IPOPT's problem: what (A) and (P) are."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Pose
from solver.fitting.reference.common import Listener, Problem, Reference, solve
from solver.fitting.reference.expression import Expression
from solver.surface import Floats, Ints


def minimise(
    expression: Expression,
    S: sp.csr_array,
    start: Pose,
    x: Floats,
    tolerance: float,
    max_iterations: int,
    listen: Listener | None = None,
) -> Reference:
    """Minimise f over one expression's variables, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError`.
    """
    problem = OneExpression(expression, S, listen)
    begin = expression.start(start, x)
    forces = np.zeros(expression.flesh.size)
    found = solve(problem, begin, forces, tolerance, max_iterations)
    pose, x = expression.pose(found.z), expression.place(found.z)
    return found.checked(Reference(pose, x, found.objective, found.iterations, found.violation))


class OneExpression(Problem):
    """Variables and constraints are those of the expression, S being fixed."""

    def __init__(
        self, expression: Expression, S: sp.csr_array, listen: Listener | None = None
    ) -> None:
        super().__init__(listen)
        self._expression = expression
        self._S = S

    def objective(self, z: Floats) -> float:
        """See :class:`Problem`."""
        return self._expression.objective(z)

    def gradient(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self._expression.gradient(z)

    def constraints(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self._expression.constraints(z, self._S)

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`Problem`."""
        return self._expression.jacobian_structure

    def jacobian(self, z: Floats) -> Floats:
        """See :class:`Problem`."""
        return self._expression.jacobian(z, self._S)

    def hessianstructure(self) -> tuple[Ints, Ints]:
        """See :class:`Problem`."""
        return self._expression.hessian_structure

    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:  # noqa: ARG002
        """See :class:`Problem`."""
        return factor * self._expression.hessian(z)
