"""Fitting the per-tet model: what is asked for and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

from solver.errors import InputError
from solver.fitting.face import Face, State
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.per_tet.creep import STEPS, VISCOSITIES, creep
from solver.fitting.per_tet.descent import Descent, Listener, Status
from solver.fitting.per_tet.objective import Objective, PerTetOptions
from solver.fitting.terms import Term
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

    ``face`` should have the material :data:`~solver.fitting.per_tet.tissue.PHACE`. ``listen`` hears
    of equilibria only, not of steps in viscous flesh. Raises :class:`InputError`
    (``model.no_fibres``, ``model.no_muscle``, ``start.activations``) and :class:`SolveError` if the
    face can not be settled.
    """
    options = options or PerTetOptions()
    tissue = tissues.of_face(face)
    state = start or tissues.rest_state(tissue)
    if state.pose.a.shape != (len(tissue.active), 6):
        raise InputError("start.activations", "the start has not six activations per active tet")
    objective = Objective(tissue, data, options, state.pose.b)
    taken = 0
    if start is None:
        # half the iterations at most are for the viscous flesh
        steps = min(STEPS, options.max_iterations // (2 * len(VISCOSITIES)))
        state, taken = creep(tissue, data, options, state, steps)
    descent = Descent(objective, state, listen, taken)
    found = descent.run(options.max_iterations, options.tolerance)
    pose = found.state.pose
    state = tissue.face.settle(tissue.selection, pose, found.state.x)
    return PerTetFit(
        pose.a,
        tissue.active,
        objective.contractions(pose.a),
        state,
        objective.value(state),
        found.iterations,
        found.status,
    )
