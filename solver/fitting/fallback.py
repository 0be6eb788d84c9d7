"""One expression by the solver that was asked for; IPOPT steps in where the reduced solver fails.

Whatever happens there is a result: the best state that was found, at worst the resting face, and
notices that say why it is no better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from solver.errors import Finding, InputError, SolveError, make_warning
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, PosedFace
from solver.fitting.least_squares import Listener
from solver.fitting.objective import Regulariser, Term
from solver.fitting.reference import NotConvergedError
from solver.mechanics.flesh import IDENTITY

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


@dataclass(frozen=True)
class FallbackFit:
    """A settled state, f there, and how it was found.

    ``status`` is ``stopped`` where the iterations ran out, ``failed`` where the solver broke down.
    """

    state: PosedFace
    objective: float
    iterations: int
    solver: Solver
    status: Status
    notices: tuple[Finding, ...] = ()


def fit(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    options: ActivationOptions,
    solver: Solver = "reduced",
    listen: Listener | None = None,
    *,
    start: PosedFace | None = None,
    ipopt: FallbackOptions = FallbackOptions(),
) -> FallbackFit:
    """Minimise f over (a, b); raises :class:`SolveError` only where the neutral face has no rest.

    The reduced solver begins at ``start``, if given, which may be no more than approached. Within
    limits there is no IPOPT: what the reduced solver cannot fit stays where it began, or at rest
    where that is better.
    """
    if solver == "ipopt":
        refuse_limits(face)
    reasons: tuple[Finding, ...] = ()
    if solver == "reduced":
        try:
            found = activation.fit(face, data, regulariser, start, options, listen)
            status: Status = "converged" if found.converged else "stopped"
            return FallbackFit(found.state, found.objective, found.iterations, solver, status)
        except (SolveError, np.linalg.LinAlgError) as error:
            # IPOPT knows six free numbers of each muscle alone
            whole = face.layout.muscles.shape == (face.model.muscle_count, len(IDENTITY))
            if face.layout.bounds.feasible is not None or not whole:
                notice = make_warning("solve.failed", f"no fit was found ({error})")
                rest = _at_rest(face, data, regulariser, solver, (notice,))
                return _better(face, data, regulariser, start, rest)
            message = f"the reduced solver failed ({error}); IPOPT took over"
            context = {"reason": getattr(error, "code", "solve.singular")}
            reasons = (make_warning("solve.fallback", message, context),)
    instead = _fit_in_full(face, data, regulariser, options, listen, ipopt)
    return replace(instead, notices=(*reasons, *instead.notices))


def _better(
    face: Face, data: Term, regulariser: Regulariser, start: PosedFace | None, rest: FallbackFit
) -> FallbackFit:
    """Return the face as a fit began, settled, or at rest: whichever has the lower f."""
    if start is None:
        return rest
    try:
        settled = face.settle(start.pose, start.x)
    except (SolveError, np.linalg.LinAlgError):
        return rest
    if settled is None:
        return rest
    value = activation.objective(data, regulariser, settled)
    return replace(rest, state=settled, objective=value) if value < rest.objective else rest


def _fit_in_full(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    options: ActivationOptions,
    listen: Listener | None,
    ipopt: FallbackOptions,
) -> FallbackFit:
    """Do as :func:`fit` by IPOPT: the best of its answers, settled, and the resting face."""
    best = _at_rest(face, data, regulariser, "ipopt")
    done = 0
    trouble: dict[str, Finding] = {}
    # where IPOPT does not converge it tries with heavier priors, each time from the best state:
    # there the flesh does not buckle, and the answer is nearby
    for heavier in ipopt.heavier:
        start = best.state
        before = done

        def report(iteration: int, value: float, before: int = before) -> None:
            if listen:
                listen((before + iteration) // ipopt.iterations, value)

        try:
            found = reference.activations(
                face,
                data,
                replace(regulariser, w_a=heavier * regulariser.w_a),
                start.pose,
                start.x,
                tolerance=ipopt.tolerance,
                max_iterations=ipopt.iterations * options.max_iterations,
                listen=report,
            )
            wanted = heavier == 1.0
        except NotConvergedError as error:
            found = error.last
            wanted = False
            trouble[error.code] = error.notice("the best result is kept")
        done += found.iterations
        state = face.settle(found.pose, found.x)
        if state is None:
            message = "what IPOPT found does not come to rest; the best result is kept"
            trouble["ipopt.unsettled"] = make_warning("ipopt.unsettled", message)
            continue
        value = activation.objective(data, regulariser, state)
        if value < best.objective:
            status: Status = "converged" if wanted else "stopped"
            best = replace(best, state=state, objective=value, status=status)
        if wanted:
            return replace(best, iterations=done)
    return replace(best, iterations=done, notices=tuple(trouble.values()))


def refuse_limits(face: Face) -> None:
    """Raise :class:`InputError` (``solver.limits``) for IPOPT on a face with limits."""
    if face.layout.bounds.feasible is not None:
        message = "ipopt fits free activations only: fit with the reduced solver within limits"
        raise InputError("solver.limits", message)


def _at_rest(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    solver: Solver,
    notices: tuple[Finding, ...] = (),
) -> FallbackFit:
    """Return the resting face, where nothing better was found."""
    value = activation.objective(data, regulariser, face.rest)
    return FallbackFit(face.rest, value, 0, solver, "failed", notices)


def warn_of_slowness(face: Face, options: FallbackOptions = FallbackOptions()) -> list[Finding]:
    """Return a warning if IPOPT will take minutes for an expression of ``face``."""
    vertices = len(face.model.rest)
    if vertices <= options.slow_vertices:
        return []
    message = f"solver ipopt takes minutes for an expression on a mesh of {vertices} vertices"
    return [make_warning("solver.slow", message, {"found": vertices})]
