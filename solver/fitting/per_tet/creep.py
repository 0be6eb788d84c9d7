"""From the neutral face towards a target through viscous flesh, which creeps where flesh snaps.

Single tets take extreme activations, under which the flesh buckles again and again; at a fold no
short step helps, and what a long one leads to is chance. Viscous flesh has no folds: each step
starts with the creep since the one before, so a fit sees buckling begin and goes against it. The
viscosity falls from step to step, and what is left of it is settled at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from solver.errors import SolveError
from solver.fitting.face import State
from solver.fitting.per_tet.damping import Damping
from solver.fitting.per_tet.objective import Objective, PerTetOptions
from solver.fitting.per_tet.saddle import SaddleSolver
from solver.fitting.per_tet.steps import CORRECTIONS, Step
from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.terms import Term
from solver.mechanics.viscous import Viscous

VISCOSITIES = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Parts of the stiffness at rest; with less the flesh snaps on the way as it does without."""

STEPS = 4
"""Steps with each of them."""

TRIES = 3


def creep(
    tissue: Tissue,
    data: Term,
    options: PerTetOptions,
    start: State,
    viscosities: Sequence[float],
    steps: int,
) -> tuple[State, int]:
    """Return an equilibrium near the target and the steps to it, ``steps`` with each viscosity.

    It is ``start`` where nothing better is found.
    """
    flesh = Viscous(tissue.face.flesh)
    viscous = replace(tissue, face=tissue.face.with_flesh(flesh))
    objective = Objective(viscous, data, options, start.pose.b)
    solver = SaddleSolver(viscous)
    state, damping, taken = start, Damping.start(len(tissue.active)), 0
    for viscosity in np.repeat(viscosities, steps):
        flesh.viscosity, flesh.anchor = float(viscosity), state.x
        try:
            state = viscous.face.settle(
                viscous.selection, state.pose, state.x, max_iterations=CORRECTIONS
            )
            step = Step.of(objective, solver, state, objective.value(state), damping)
        except SolveError:
            break
        taken += 1
        found = step.descend(objective, TRIES)
        if found is None:
            damping = damping.after_refusal()
        else:
            state, damping = found
    try:
        end = tissue.face.settle(tissue.selection, state.pose, state.x)
    except SolveError:
        return start, taken
    return min(start, end, key=objective.value), taken
