"""Common to IPOPT's problems: the call of IPOPT, and its answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import cyipopt
import numpy as np

from solver.errors import Finding, SolveError, make_warning
from solver.fitting.face import Pose
from solver.fitting.least_squares import Listener
from solver.surface import Floats

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
        """Return it as a notice that says what is ``kept``."""
        return make_warning(self.code, f"{self.message}; {kept}", self.context)


class IpoptProblem:
    """A problem in cyipopt's form: minimise the objective under constraints, z (n,) being free.

    It has ``objective`` (z) and ``gradient`` (z); ``hessianstructure`` (), rows and columns of the
    Hessian's lower triangle, where entries that repeat are summed; ``hessian`` (z, multipliers,
    factor), the entries of ``factor`` times the objective's Gauss-Newton Hessian; and where there
    are constraints ``constraints`` (z), ``jacobianstructure`` () and ``jacobian`` (z).
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
