"""From equilibrium to equilibrium to a minimum of f; where the flesh folds, over the fold.

At a fold no short step helps: the flesh snaps into another equilibrium, where f may at first be
higher. The best state of all is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from solver.errors import SolveError
from solver.fitting import stretches
from solver.fitting.face import Pose, State
from solver.fitting.objective import Term
from solver.fitting.per_tet.damping import Damping
from solver.fitting.per_tet.objective import Objective, PerTetOptions
from solver.fitting.per_tet.saddle import Quadratic, SaddleSolver
from solver.fitting.per_tet.tissue import Tissue
from solver.surface import Floats

# From one equilibrium of a per-tet model to the next, along a Gauss-Newton step.


CORRECTIONS = 8  # Newton steps to an equilibrium nearby


@dataclass(frozen=True)
class TetStep:
    """A step (a, b) from a state where f is ``value``, and the damping if it is taken as it is."""

    state: State
    value: float
    model: Quadratic
    a: Floats
    b: Floats
    lowered: Damping

    @classmethod
    def of(
        cls,
        objective: Objective,
        solver: SaddleSolver,
        state: State,
        value: float,
        damping: Damping,
    ) -> TetStep:
        """Minimise the damped Gauss-Newton model at a state."""
        model = objective.quadratic(state, damping.tets, damping.jaw)
        a, b = state.pose.layout.split(solver.step(model, state))
        return cls(state, value, model, *damping.limit(state.pose.a, a, b))

    def pose(self, fraction: float = 1.0) -> Pose:
        """Return the pose that a fraction of the step leads to."""
        before = self.state.pose
        return Pose(stretches.move(before.a, fraction * self.a), before.b + fraction * self.b)

    def descend(self, objective: Objective, tries: int) -> tuple[State, Damping] | None:
        """Return the first state along the step, halved and halved, with a lower f, and a damping.

        None if there is none in so many ``tries``.
        """
        for halving in range(tries):
            try:
                trial = self._reach(objective.tissue, self.pose(0.5**halving))
            except SolveError:
                continue
            if trial.equilibrium.minimum and objective.value(trial) < self.value:
                return trial, self.lowered.scale(2.0**halving)
        return None

    def _reach(self, tissue: Tissue, pose: Pose) -> State:
        """Go to the equilibrium of a pose nearby; raises :class:`SolveError`.

        Approaching is not enough here: single tets are so soft that the flesh may buckle on the
        rest of the way, and the derivatives would be those of another equilibrium.
        """
        before = self.state.pose
        motion = self.model.response.motion(pose.vector() - before.vector())
        free = motion.ravel()[self.model.response.free]
        near = tissue.face.newton_predict(self.state, free, pose)
        return tissue.face.solve_equilibrium(pose, near.x, max_iterations=CORRECTIONS)


@dataclass(frozen=True)
class FoldOptions:
    """The descent near folds, and its end."""

    tries: int = 2  # whole and half steps before the damping grows
    snaps: int = 6  # over a fold, at most
    snap_loss: float = 2.5  # f behind a fold, as a multiple of the least, at most
    snap_iterations: int = 30  # Newton steps to an equilibrium behind a fold
    small_gains: int = 2  # in turn, at the end: a single one may just have been damped
    unstuck: float = 0.02  # gain, relative to f, after which a refused step is forgotten
    patience: int = 6  # iterations without a new least f before it counts as the minimum


# called after each accepted step with the iteration and the least objective so far
Listener = Callable[[int, float], None]


class Status(StrEnum):
    """Why a fit ended."""

    CONVERGED = "converged"
    NO_DESCENT = "no descent"
    ITERATIONS = "iterations"


@dataclass(frozen=True)
class Found:
    """The best state, its f, the iterations and why there are no more."""

    state: State
    value: float
    iterations: int
    status: Status


class Descent:
    """Minimises f from ``state``, iterations being counted from ``taken``."""

    def __init__(
        self,
        objective: Objective,
        state: State,
        listen: Listener | None,
        taken: int,
        options: FoldOptions = FoldOptions(),
    ) -> None:
        self._options = options
        self._objective = objective
        self._listen = listen
        self._solver = SaddleSolver(objective.tissue)
        self._damping = self._first_damping()
        self._state, self._value = state, objective.value(state)
        self._best = self._state, self._value
        self._taken = taken
        self._since_best = self._small = self._snaps = 0
        self._stuck = self._slow = False

    def run(self, max_iterations: int, tolerance: float) -> Found:
        """Go on until ``max_iterations``, or steps that gain less than ``tolerance`` f."""
        while self._taken < max_iterations:
            self._taken += 1
            self._since_best += 1
            if not self._advance(tolerance):
                return self._found(Status.NO_DESCENT)
            if self._small == self._options.small_gains:
                return self._found(Status.CONVERGED)
            if self._since_best == self._options.patience:
                return self._found(Status.NO_DESCENT)
        return self._found(Status.ITERATIONS)

    def _advance(self, tolerance: float) -> bool:
        """Take a step, or have the next one shorter; False if there is none that leads on."""
        crawls = self._slow and self._damping.is_hindered
        if crawls:
            self._damping = self._first_damping()
        try:
            step = TetStep.of(
                self._objective, self._solver, self._state, self._value, self._damping
            )
        except SolveError:
            return False
        found = None if crawls else step.descend(self._objective, self._options.tries)
        if found is None and not (self._stuck or crawls):
            self._stuck, self._damping = True, self._damping.after_refusal()
            return True
        if found is None and self._snaps < self._options.snaps:
            self._snaps += 1
            self._stuck = False
            found = self._snap(step)
        if found is None:
            return False
        self._take(*found, tolerance)
        return True

    def _snap(self, step: TetStep) -> tuple[State, Damping] | None:
        """Return the equilibrium at the end of a step, however far that is, if f is not too high.

        Half the step is tried where the whole one leads nowhere.
        """
        tissue = self._objective.tissue
        for fraction in (1.0, 0.5):
            try:
                state = tissue.face.solve_equilibrium(
                    step.pose(fraction), step.state.x, max_iterations=self._options.snap_iterations
                )
            except SolveError:
                continue
            limit = self._options.snap_loss * self._best[1]
            if state.equilibrium.minimum and self._objective.value(state) < limit:
                return state, step.lowered.afresh()
        return None

    def _take(self, state: State, damping: Damping, tolerance: float) -> None:
        """Go to a state."""
        value = self._objective.value(state)
        gain = self._value - value
        self._state, self._value, self._damping = state, value, damping
        self._slow = 0.0 <= gain < self._options.unstuck * value
        self._stuck = self._stuck and self._slow
        self._small = self._small + 1 if 0.0 <= gain <= tolerance * value else 0
        if value < self._best[1]:
            self._best, self._since_best = (state, value), 0
        if self._listen:
            self._listen(self._taken, self._best[1])

    def _found(self, status: Status) -> Found:
        return Found(*self._best, self._taken, status)

    def _first_damping(self) -> Damping:
        return Damping.start(len(self._objective.tissue.active))


# From the neutral face towards a target through viscous flesh, which creeps where flesh snaps.
#
# Single tets take extreme activations, under which the flesh buckles again and again; at a fold no
# short step helps, and what a long one leads to is chance. Viscous flesh has no folds: each step
# starts with the creep since the one before, so a fit sees buckling begin and goes against it. The
# viscosity falls from step to step, and what is left of it is settled at the end.


@dataclass(frozen=True)
class CreepOptions:
    """The way through viscous flesh."""

    # relative to the stiffness at rest; with less the flesh snaps on the way as it does without
    viscosities: tuple[float, ...] = (1.0, 0.5, 0.25, 0.12, 0.06)
    steps: int = 4  # with each of them
    tries: int = 3  # whole, half and quarter steps before the damping grows
    cycles: int = 4  # times that the flesh creeps: again from wherever a descent gets stuck ...
    enough: float = 0.97  # ... as long as it leaves this much of f at most


def creep(
    tissue: Tissue,
    data: Term,
    options: PerTetOptions,
    start: State,
    viscosities: Sequence[float],
    steps: int,
    tries: int = CreepOptions.tries,
) -> tuple[State, int]:
    """Return an equilibrium near the target and the steps to it, ``steps`` with each viscosity.

    It is ``start`` where nothing better is found.
    """
    flesh = tissue.face.flesh
    drags = flesh.drags()
    viscous = replace(tissue, face=tissue.face.with_flesh(flesh.plus(*drags)))
    objective = Objective(viscous, data, options, start.pose.b)
    solver = SaddleSolver(viscous)
    state, damping, taken = start, Damping.start(len(tissue.active)), 0
    for viscosity in np.repeat(viscosities, steps):
        for drag in drags:
            drag.viscosity, drag.anchor = float(viscosity), state.x
        try:
            state = viscous.face.solve_equilibrium(state.pose, state.x, max_iterations=CORRECTIONS)
            step = TetStep.of(objective, solver, state, objective.value(state), damping)
        except SolveError:
            break
        taken += 1
        found = step.descend(objective, tries)
        if found is None:
            damping = damping.after_refusal()
        else:
            state, damping = found
    try:
        end = tissue.face.solve_equilibrium(state.pose, state.x)
    except SolveError:
        return start, taken
    return min(start, end, key=objective.value), taken
