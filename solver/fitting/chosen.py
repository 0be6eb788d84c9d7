"""One expression by the solver that was asked for; IPOPT steps in where the reduced solver fails.

Whatever happens there is a result: the best state that was found, at worst the resting face, and
notices that say why it is no better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions, Listener
from solver.fitting.face import Face, State
from solver.fitting.notices import Notice
from solver.fitting.objective import Regulariser
from solver.fitting.reference import NotConvergedError
from solver.fitting.terms import Term

Solver = Literal["reduced", "ipopt"]
Status = Literal["converged", "stopped", "failed"]

IPOPT_ITERATIONS = 20
"""Iterations that IPOPT, whose steps are shorter and cheaper, may take for one Gauss-Newton step."""

IPOPT_TOLERANCE = 1e-4


@dataclass(frozen=True)
class ChosenFit:
    """A settled state, f there, and how it was found.

    ``status`` is ``stopped`` where the iterations ran out, ``failed`` where the solver broke down
    and ``state`` is the best of what there was.
    """

    state: State
    objective: float
    iterations: int
    solver: Solver
    status: Status
    notices: tuple[Notice, ...]


def fit(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    rest: State,
    options: ActivationOptions,
    solver: Solver = "reduced",
    listen: Listener | None = None,
) -> ChosenFit:
    """Minimise f over (a, b) from the resting face ``rest``; never raises :class:`SolveError`."""
    if solver == "ipopt":
        return by_ipopt(face, S, data, regulariser, rest, options, listen)
    try:
        found = activation.fit(face, S, data, regulariser, rest, options, listen)
    except (SolveError, np.linalg.LinAlgError) as error:
        reason = Notice(
            "solve.fallback",
            f"the reduced solver failed ({error}); IPOPT took over",
            {"reason": getattr(error, "code", "solve.singular")},
        )
        instead = by_ipopt(face, S, data, regulariser, rest, options, listen)
        return ChosenFit(
            instead.state,
            instead.objective,
            instead.iterations,
            instead.solver,
            instead.status,
            (reason, *instead.notices),
        )
    status: Status = "converged" if found.converged else "stopped"
    return ChosenFit(found.state, found.objective, found.iterations, "reduced", status, ())


def by_ipopt(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    rest: State,
    options: ActivationOptions,
    listen: Listener | None = None,
) -> ChosenFit:
    """Do as :func:`fit` by IPOPT; its answer is settled, and compared with the resting face."""
    notices: list[Notice] = []
    status: Status = "converged"
    limit = IPOPT_ITERATIONS * options.max_iterations

    def scaled(iteration: int, value: float) -> None:
        if listen:
            listen(iteration // IPOPT_ITERATIONS, value)

    try:
        found = reference.activations(
            face,
            S,
            data,
            regulariser,
            rest.pose,
            rest.x,
            tolerance=IPOPT_TOLERANCE,
            max_iterations=limit,
            listen=scaled,
        )
    except NotConvergedError as error:
        found = error.last
        status = "stopped" if error.context["iterations"] >= limit else "failed"
        message = f"{error.message}; the best result so far is kept"
        notices.append(Notice(error.code, message, error.context))
    best, value = rest, activation.objective(data, regulariser, rest)
    try:
        state = face.settle(S, found.pose, found.x)
    except SolveError as error:
        status = "failed"
        message = f"what IPOPT found does not come to rest ({error}); the resting face is kept"
        notices.append(Notice("ipopt.unsettled", message, {"reason": error.code}))
    else:
        settled = activation.objective(data, regulariser, state)
        if settled < value:
            best, value = state, settled
    return ChosenFit(best, value, found.iterations, "ipopt", status, tuple(notices))
