"""One expression by the solver that was asked for; IPOPT steps in where the reduced solver fails.

Whatever happens there is a result: the best state that was found, at worst the resting face, and
notices that say why it is no better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from solver.contact.mouth import Mouth
from solver.errors import Notice, SolveError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions, Resting
from solver.fitting.contact import Contact, Teeth
from solver.fitting.face import Face, State
from solver.fitting.least_squares import Listener
from solver.fitting.objective import (
    Regulariser,
    SkinDistance,
    Target,
    Term,
    Together,
)
from solver.fitting.reference import NotConvergedError, Reference

Solver = Literal["reduced", "ipopt"]
Status = Literal["converged", "stopped", "failed"]

IPOPT_ITERATIONS = 4
"""Iterations that IPOPT, whose steps are shorter, may take for one of Gauss-Newton."""

HEAVIER = (1.0, 100.0, 20.0, 5.0, 1.0)
"""Weights of the activations' prior that IPOPT tries, as multiples of the one that is wanted."""

IPOPT_TOLERANCE = 1e-4


UNSETTLED = Notice(
    "ipopt.unsettled", "what IPOPT found does not come to rest; the best result is kept"
)

SLOW_VERTICES = 3000
"""Vertices from which on IPOPT takes minutes for an expression."""


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
    data: Term,
    regulariser: Regulariser,
    rest: Resting,
    options: ActivationOptions,
    solver: Solver = "reduced",
    listen: Listener | None = None,
    *,
    start: State | None = None,
) -> ChosenFit:
    """Minimise f over (a, b); never raises :class:`SolveError`.

    The reduced solver begins at ``start``, if given, which may be no more than approached.
    """
    if solver == "ipopt":
        return by_ipopt(face, data, regulariser, rest, options, listen)
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
        instead = by_ipopt(face, data, regulariser, rest, options, listen)
        return replace(instead, notices=(reason, *instead.notices))
    status: Status = "converged" if found.converged else "stopped"
    return ChosenFit(found.state, found.objective, found.iterations, "reduced", status, ())


def by_ipopt(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    rest: Resting,
    options: ActivationOptions,
    listen: Listener | None = None,
) -> ChosenFit:
    """Do as :func:`fit` by IPOPT; its answer is settled, and compared with the resting face.

    Where IPOPT does not converge, it tries again with heavier priors of the activations, each time
    from the best state so far: there the flesh does not buckle, and the answer is nearby.
    """
    neutral = activation.objective(data, regulariser, rest.state)
    best = ChosenFit(rest.state, neutral, 0, "ipopt", "failed", ())
    limit = IPOPT_ITERATIONS * options.max_iterations
    done = 0
    trouble: dict[str, Notice] = {}
    for heavier in HEAVIER:
        prior = replace(regulariser, w_a=heavier * regulariser.w_a)
        start, before = best.state, done

        def scaled(iteration: int, value: float, before: int = before) -> None:
            if listen:
                listen((before + iteration) // IPOPT_ITERATIONS, value)

        try:
            found = reference.activations(
                face,
                data,
                prior,
                start.pose,
                start.x,
                tolerance=IPOPT_TOLERANCE,
                max_iterations=limit,
                listen=scaled,
            )
            converged = True
        except NotConvergedError as error:
            found, converged = error.last, False
            message = f"{error.message}; the best result is kept"
            trouble[error.code] = Notice(error.code, message, error.context)
        done += found.iterations
        state = _settled(face, found)
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


def _settled(face: Face, found: Reference) -> State | None:
    """Return the equilibrium near IPOPT's answer, None if there is none."""
    if not (np.isfinite(found.x).all() and np.isfinite(found.pose.a).all()):
        return None
    try:
        return face.solve_equilibrium(found.pose, found.x)
    except SolveError:
        return None


def slowness(face: Face) -> list[Notice]:
    """Return a warning if IPOPT will take minutes for an expression of ``face``."""
    vertices = len(face.model.rest)
    if vertices <= SLOW_VERTICES:
        return []
    message = f"solver ipopt takes minutes for an expression on a mesh of {vertices} vertices"
    return [Notice("solver.slow", message, {"found": vertices})]


# What jobs and benchmarks fit: the terms of every expression, and the weights of an unseen one.


UNSEEN = {"w_a": 1e-3, "w_v": 1e-2, "w_b": 1e-6}
"""Weights for an expression that S was not fitted to: w_a low from the start."""

UNSEEN_STOP = ActivationOptions(max_iterations=25, tolerance=1e-3)


def distances(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the distance of every expression, without contact: what a fit of S begins with."""
    return {name: SkinDistance(face, target) for name, target in targets.items()}


def terms(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the terms of every expression: the distance, and contact if the model has lips."""
    mouth = Mouth.of(face.model)
    data = distances(face, targets)
    if mouth is None:
        return data
    teeth = Teeth(face.model, mouth)
    return {
        name: Together((term, Contact(face.model, mouth, teeth))) for name, term in data.items()
    }


def unseen_regulariser(face: Face) -> Regulariser:
    """Return the regulariser of an expression that S was not fitted to, around the resting face."""
    return Regulariser(**UNSEEN, prior=face.rest_pose())
