"""One expression by the solver that was asked for; IPOPT steps in where the reduced solver fails.

Whatever happens there is a result: the best state that was found, at worst the resting face, and
notices that say why it is no better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from solver.errors import Notice, SolveError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions, Resting
from solver.fitting.face import Face, State
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Regulariser, Term
from solver.fitting.reference import NotConvergedError, Reference

Solver = Literal["reduced", "ipopt"]
Status = Literal["converged", "stopped", "failed"]


@dataclass(frozen=True)
class FallbackOptions:
    """IPOPT's effort for an expression."""

    iterations: int = 4  # for one of Gauss-Newton's, whose steps are longer
    # weights of the activations' prior in turn, as multiples of the one that is wanted
    heavier: tuple[float, ...] = (1.0, 100.0, 20.0, 5.0, 1.0)
    tolerance: float = 1e-4
    slow_vertices: int = 3000  # from which on an expression takes minutes


UNSETTLED = Notice(
    "ipopt.unsettled", "what IPOPT found does not come to rest; the best result is kept"
)


@dataclass(frozen=True)
class FallbackFit:
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
    data: Term,
    regulariser: Regulariser,
    rest: Resting,
    options: ActivationOptions,
    solver: Solver = "reduced",
    listen: Listener | None = None,
    *,
    start: State | None = None,
    ipopt: FallbackOptions = FallbackOptions(),
) -> FallbackFit:
    """Minimise f over (a, b); never raises :class:`SolveError`.

    The reduced solver begins at ``start``, if given, which may be no more than approached.
    """
    if solver == "ipopt":
        return fit_by_ipopt(face, data, regulariser, rest, options, listen, ipopt)
    try:
        if start is None:
            found = activation.fit(
                face, data, regulariser, rest.state, options, listen, matrix=rest.matrix
            )
        else:
            found = activation.fit(face, data, regulariser, start, options, listen)
    except (SolveError, np.linalg.LinAlgError) as error:
        reason = Notice(
            "solve.fallback",
            f"the reduced solver failed ({error}); IPOPT took over",
            {"reason": getattr(error, "code", "solve.singular")},
        )
        instead = fit_by_ipopt(face, data, regulariser, rest, options, listen, ipopt)
        return replace(instead, notices=(reason, *instead.notices))
    status: Status = "converged" if found.converged else "stopped"
    return FallbackFit(found.state, found.objective, found.iterations, "reduced", status, ())


def fit_by_ipopt(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    rest: Resting,
    options: ActivationOptions,
    listen: Listener | None = None,
    ipopt: FallbackOptions = FallbackOptions(),
) -> FallbackFit:
    """Do as :func:`fit` by IPOPT; its answer is settled, and compared with the resting face.

    Where IPOPT does not converge, it tries again with heavier priors of the activations, each time
    from the best state so far: there the flesh does not buckle, and the answer is nearby.
    """
    neutral = activation.objective(data, regulariser, rest.state)
    best = FallbackFit(rest.state, neutral, 0, "ipopt", "failed", ())
    limit = ipopt.iterations * options.max_iterations
    done = 0
    trouble: dict[str, Notice] = {}
    for heavier in ipopt.heavier:
        prior = replace(regulariser, w_a=heavier * regulariser.w_a)
        start, before = best.state, done

        def report(iteration: int, value: float, before: int = before) -> None:
            if listen:
                listen((before + iteration) // ipopt.iterations, value)

        try:
            found = reference.activations(
                face,
                data,
                prior,
                start.pose,
                start.x,
                tolerance=ipopt.tolerance,
                max_iterations=limit,
                listen=report,
            )
            converged = True
        except NotConvergedError as error:
            found, converged = error.last, False
            message = f"{error.message}; the best result is kept"
            trouble[error.code] = Notice(error.code, message, error.context)
        done += found.iterations
        state = _settle(face, found)
        if state is None:
            trouble[UNSETTLED.code] = UNSETTLED
            continue
        value = activation.objective(data, regulariser, state)
        if value < best.objective:
            wanted = converged and heavier == 1.0
            status: Status = "converged" if wanted else "stopped"
            best = replace(best, state=state, objective=value, status=status)
        if converged and heavier == 1.0:
            return replace(best, iterations=done)
    return replace(best, iterations=done, notices=tuple(trouble.values()))


def _settle(face: Face, found: Reference) -> State | None:
    """Return the equilibrium near IPOPT's answer, None if there is none."""
    if not (np.isfinite(found.x).all() and np.isfinite(found.pose.a).all()):
        return None
    try:
        return face.solve_equilibrium(found.pose, found.x)
    except SolveError:
        return None


def warn_of_slowness(face: Face, options: FallbackOptions = FallbackOptions()) -> list[Notice]:
    """Return a warning if IPOPT will take minutes for an expression of ``face``."""
    vertices = len(face.model.rest)
    if vertices <= options.slow_vertices:
        return []
    message = f"solver ipopt takes minutes for an expression on a mesh of {vertices} vertices"
    return [Notice("solver.slow", message, {"found": vertices})]
