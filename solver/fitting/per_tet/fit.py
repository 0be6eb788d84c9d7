"""Fitting the per-tet model: what is asked for and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

from solver.errors import InputError
from solver.fitting.face import Face, State
from solver.fitting.objective import Term
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.per_tet.descent import CreepOptions, Descent, Listener, Status, creep
from solver.fitting.per_tet.objective import Objective, PerTetOptions
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class PerTetFit:
    """A fitted state, settled.

    ``a`` (n_active, 6) are the activations of the tets ``active`` (n_active,), ``gamma`` (m,) the
    muscles' preferred contractions, above 1 where they shorten. ``iterations`` counts steps,
    refused ones and those in viscous flesh too.
    """

    a: Floats
    active: Ints
    gamma: Floats
    state: State
    objective: float
    iterations: int
    status: Status


def fit(
    face: Face,
    data: Term,
    start: State | None = None,
    options: PerTetOptions | None = None,
    listen: Listener | None = None,
) -> PerTetFit:
    """Minimise f from ``start``, a state of another such fit, or from the neutral face; settle it.

    ``face`` should have the material :data:`~solver.mechanics.flesh.COROTATED_DET`. ``listen``
    hears of equilibria only, not of steps in viscous flesh. Raises :class:`InputError`
    (``model.no_fibres``, ``model.no_muscle``, ``start.activations``) and :class:`SolveError` if the
    face cannot be settled.
    """
    options, creeping = options or PerTetOptions(), CreepOptions()
    tissue = tissues.of_face(face)
    state = start or tissue.face.rest
    if state.pose.layout is not tissue.face.layout:
        raise InputError("start.activations", "the start has not six activations per active tet")
    objective = Objective(tissue, data, options, state.pose.b)
    taken, value = 0, objective.value(state)
    for cycle in range(creeping.cycles):
        if cycle or start is None:
            # half the iterations at most are for the viscous flesh
            left = options.max_iterations - taken
            viscosities = creeping.viscosities[min(cycle, 1) :]
            steps = min(creeping.steps, left // (2 * len(viscosities)))
            state, crept = creep(tissue, data, options, state, viscosities, steps)
            taken += crept
        descent = Descent(objective, state, listen, taken)
        found = descent.run(options.max_iterations, options.tolerance)
        state, taken = found.state, found.iterations
        before, value = value, objective.value(state)
        if found.status != Status.NO_DESCENT or value > creeping.enough * before:
            break
    pose = found.state.pose
    state = tissue.face.solve_equilibrium(pose, found.state.x)
    return PerTetFit(
        pose.a,
        tissue.active,
        objective.priors.contraction.contractions(pose.a),
        state,
        objective.value(state),
        found.iterations,
        found.status,
    )
