"""The fit of the per-tet model: through viscous flesh, then from equilibrium to equilibrium.

Single tets take extreme activations, under which the flesh buckles again and again; at a fold no
short step helps, and what a long one leads to is chance. Viscous flesh has no folds: each step
starts with the creep since the one before, so a fit sees buckling begin and goes against it. The
viscosity falls from step to step. Then the descent goes in equilibria; where the flesh folds it
snaps over the fold into another one, where f may at first be higher. The best state of all is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting import activation, stretches
from solver.fitting.activation import UNSEEN_STOP, unseen_regulariser
from solver.fitting.controls import JAW_UNITS
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.least_squares import DampingOptions, Listener
from solver.fitting.objective import Term
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.per_tet.objective import PER_TET, Objective, PerTetOptions
from solver.fitting.per_tet.saddle import Quadratic, SaddleSolver
from solver.fitting.per_tet.tissue import Tissue
from solver.mechanics.equilibrium import PredictorOptions
from solver.mechanics.flesh import Drag
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class TetDescentOptions:
    """Trust in the linear model, the rules of the dampings, and the way down."""

    largest_step: float = 0.5  # a tet's change |dS(a_i)|, relative
    largest_jaw_step: float = 2.0  # mm
    # motion of the mandible, mm, from which it is put in place before tets move: they reach a wide
    # open mouth without it otherwise, and it has no reason to follow
    wide_jaw: float = 10.0
    tets: DampingOptions = field(default_factory=lambda: DampingOptions(1.0, least=1e-7, grow=8.0))
    jaw: DampingOptions = field(default_factory=lambda: DampingOptions(1e-2, least=1e-7, grow=8.0))
    refused: float = 16.0  # factor for all when a step and its half are refused
    # beside a fold only short steps lead down: so many more are tried, ever more damped, while f is
    # at least so many times what viscous flesh came to, if in states that may not hold without drag
    refusals: int = 4
    behind: float = 2.0

    corrections: int = 8  # Newton steps to an equilibrium nearby
    tries: int = 2  # whole and half steps before the damping grows
    snaps: int = 6  # over a fold, at most
    snap_loss: float = 2.5  # f behind a fold, as a multiple of the least, at most
    snap_iterations: int = 30  # Newton steps to an equilibrium behind a fold
    small_gains: int = 2  # in turn, at the end: a single one may just have been damped
    unstuck: float = 0.02  # gain, relative to f, after which a refused step is forgotten
    patience: int = 6  # iterations without a new least f before it counts as the minimum

    # relative to the stiffness at rest; with less the flesh snaps on the way as it does without
    viscosities: tuple[float, ...] = (1.0, 0.5, 0.25, 0.12, 0.06)
    viscous_steps: int = 4  # with each of them
    viscous_tries: int = 3  # whole, half and quarter steps before the damping grows
    cycles: int = 4  # times that the flesh creeps: again from wherever a descent gets stuck ...
    enough: float = 0.97  # ... as long as it leaves this much of f at most


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt damping, one of each active tet, ``tets`` (n_active,), and the ``jaw``'s.

    The flesh may need ten times more of one tet than of another: so no activation outruns the
    linear model, and none waits for others. They fall to no less than ``fall`` times themselves a
    step, and more slowly after every refused step.
    """

    tets: Floats
    jaw: float
    fall: float
    options: TetDescentOptions

    @classmethod
    def start(cls, count: int, options: TetDescentOptions = TetDescentOptions()) -> Damping:
        """Return the damping of the first step."""
        tets = np.full(count, options.tets.start)
        return cls(tets, options.jaw.start, 1.0 / options.tets.shrink, options)

    def limit(self, at: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats, Damping]:
        """Cut a step (a, b) from activations ``at`` tet by tet; return it and the next damping."""
        options = self.options
        square = np.einsum("ei,eij,ej->e", a, stretches.metric(at), a)
        length = np.sqrt(square) / options.largest_step
        jaw_length = float(np.abs(JAW_UNITS * b).max()) / options.largest_jaw_step
        cut_a = a / np.maximum(length, 1.0)[:, None]
        cut_b = b / max(jaw_length, 1.0)
        tets = options.tets.scale(self.tets, length, self.fall)
        jaw = options.jaw.scale(np.array(self.jaw), np.array(jaw_length), self.fall)
        return cut_a, cut_b, replace(self, tets=tets, jaw=float(jaw))

    def scale(self, factor: float) -> Damping:
        """Return this damping times ``factor``."""
        return replace(self, tets=factor * self.tets, jaw=factor * self.jaw)

    @property
    def is_hindered(self) -> bool:
        """Tell whether small gains may be the damping's doing."""
        return self.fall > 1.0 / self.options.tets.shrink

    def without_refusals(self) -> Damping:
        """Return this damping without the memory of refused steps."""
        return replace(self, fall=1.0 / self.options.tets.shrink)

    def after_refusal(self) -> Damping:
        """Return the damping to try again with."""
        return replace(self.scale(self.options.refused), fall=float(np.sqrt(self.fall)))


@dataclass(frozen=True)
class TetStep:
    """A step (a, b) from a state where f is ``value``."""

    state: PosedFace
    value: float
    model: Quadratic
    a: Floats
    b: Floats
    lowered: Damping  # if the step is taken as it is

    @classmethod
    def of(
        cls, objective: Objective, solver: SaddleSolver, state: PosedFace, damping: Damping
    ) -> TetStep:
        """Minimise the damped Gauss-Newton model at a state."""
        model = objective.quadratic(state, damping.tets, damping.jaw)
        whole_a, whole_b = state.pose.layout.split(solver.step(model))
        a, b, lowered = damping.limit(state.pose.a, whole_a, whole_b)
        return cls(state, objective.value(state), model, a, b, lowered)

    def pose(self, fraction: float = 1.0) -> Pose:
        """Return the pose that a fraction of the step leads to."""
        before = self.state.pose
        return Pose(stretches.move(before.a, fraction * self.a), before.b + fraction * self.b)

    def descend(self, objective: Objective, tries: int) -> tuple[PosedFace, Damping] | None:
        """Return the first state along the step and its halves with a lower f, and a damping."""
        for halving in range(tries):
            try:
                trial = self._reach(objective.tissue.face, self.pose(0.5**halving))
            except SolveError:
                continue
            if trial.equilibrium.minimum and objective.value(trial) < self.value:
                return trial, self.lowered.scale(2.0**halving)
        return None

    def _reach(self, face: Face, pose: Pose) -> PosedFace:
        # approaching is not enough: single tets are so soft that the flesh may buckle on the rest
        # of the way, and the derivatives would be those of another equilibrium
        change = pose.vector() - self.state.pose.vector()
        sensitivity = self.model.sensitivity
        motion = sensitivity.response.free_motion(sensitivity.pose, change)
        near = face.newton_predict(self.state, motion, pose, PredictorOptions.reach_mm)
        corrections = self.lowered.options.corrections
        return face.solve_equilibrium(pose, near.x, max_iterations=corrections)


class Status(StrEnum):
    """Reasons for a fit to end."""

    CONVERGED = "converged"
    NO_DESCENT = "no descent"
    ITERATIONS = "iterations"


class Descent:
    """Minimises f from ``state``, iterations being counted from ``taken``.

    ``best`` is the state of the least f, and that; ``listen`` hears of the least f so far;
    ``reachable`` is an f that viscous flesh came to: well above it refused steps are no end.
    """

    def __init__(
        self,
        objective: Objective,
        state: PosedFace,
        listen: Listener | None,
        taken: int,
        options: TetDescentOptions,
        reachable: float = np.inf,
    ) -> None:
        self._objective = objective
        self._options = options
        self._listen = listen
        self._reachable = reachable
        self._solver = SaddleSolver(objective.tissue)
        self._first = Damping.start(len(objective.tissue.active), options)
        self._damping = self._first
        self._state = state
        self._value = objective.value(state)
        self.best = self._state, self._value
        self.taken = taken
        self._since_best = 0  # iterations
        self._small = 0  # gains in turn
        self._snaps = 0
        self._refusals = 0  # in turn, since the snap that was tried
        self._stuck = False  # a step was refused, and little gained since
        self._slow = False  # the last step gained little

    def run(self, max_iterations: int, tolerance: float) -> Status:
        """Go on until ``max_iterations``, or steps that gain less than ``tolerance`` f."""
        while self.taken < max_iterations:
            self.taken += 1
            self._since_best += 1
            if not self._advance(tolerance):
                return Status.NO_DESCENT
            if self._small == self._options.small_gains:
                return Status.CONVERGED
            if self._since_best == self._options.patience:
                return Status.NO_DESCENT
        return Status.ITERATIONS

    def _advance(self, tolerance: float) -> bool:
        """Take a step, or have the next one shorter; False if there is none that leads on."""
        crawls = self._slow and self._damping.is_hindered
        if crawls:
            self._damping = self._first
        try:
            step = TetStep.of(self._objective, self._solver, self._state, self._damping)
        except SolveError:
            return False
        found = None if crawls else step.descend(self._objective, self._options.tries)
        if found is None and not (self._stuck or crawls):
            self._stuck, self._damping = True, self._damping.after_refusal()
            return True
        if found is None and not self._refusals and self._snaps < self._options.snaps:
            self._snaps += 1
            self._stuck = False
            found = self._snap(step)
        if found is None:
            return self._refuse()
        self._take(*found, tolerance)
        return True

    def _refuse(self) -> bool:
        """Have the next step shorter; False where there is no reason to."""
        self._refusals += 1
        self._stuck = True
        self._slow = False
        self._damping = self._damping.after_refusal()
        options = self._options
        is_behind = self.best[1] > options.behind * self._reachable
        return is_behind and self._refusals <= options.refusals

    def _snap(self, step: TetStep) -> tuple[PosedFace, Damping] | None:
        """Return the equilibrium at the end of a step, or of its half, where f is not too high."""
        face = self._objective.tissue.face
        most = self._options.snap_iterations
        for fraction in (1.0, 0.5):
            try:
                pose = step.pose(fraction)
                state = face.solve_equilibrium(pose, step.state.x, max_iterations=most)
            except SolveError:
                continue
            limit = self._options.snap_loss * self.best[1]
            if state.equilibrium.minimum and self._objective.value(state) < limit:
                return state, step.lowered.without_refusals()
        return None

    def _take(self, state: PosedFace, damping: Damping, tolerance: float) -> None:
        """Go to a state."""
        value = self._objective.value(state)
        gain = self._value - value
        self._state = state
        self._value = value
        self._damping = damping
        self._refusals = 0
        self._slow = 0.0 <= gain < self._options.unstuck * value
        self._stuck = self._stuck and self._slow
        self._small = self._small + 1 if 0.0 <= gain <= tolerance * value else 0
        if value < self.best[1]:
            self.best = (state, value)
            self._since_best = 0
        if self._listen:
            self._listen(self.taken, self.best[1])


def creep(
    tissue: Tissue,
    data: Term,
    weights: PerTetOptions,
    start: PosedFace,
    viscosities: Sequence[float],
    steps: int,
    options: TetDescentOptions,
) -> tuple[PosedFace, int, float]:
    """Return an equilibrium near the target, ``start`` at worst, the steps to it, and the least f.

    They lead through viscous flesh, ``steps`` with each viscosity, and so does that f.
    """
    flesh = tissue.face.flesh
    drag = Drag(flesh)
    viscous = replace(tissue, face=tissue.face.with_flesh(flesh.slowed_by(drag)))
    objective = Objective(viscous, data, weights, start.pose.b)
    solver = SaddleSolver(viscous)
    face = viscous.face
    state = start
    damping = Damping.start(len(tissue.active), options)
    taken = 0
    least = np.inf
    for viscosity in np.repeat(viscosities, steps):
        drag.viscosity = float(viscosity)
        drag.anchor = state.x
        try:
            state = face.solve_equilibrium(state.pose, state.x, max_iterations=options.corrections)
            step = TetStep.of(objective, solver, state, damping)
        except SolveError:
            break
        taken += 1
        found = step.descend(objective, options.viscous_tries)
        state, damping = found or (state, damping.after_refusal())
        least = min(least, objective.value(state))
    end = tissue.face.settle(state.pose, state.x)
    return (start if end is None else min(start, end, key=objective.value)), taken, least


@dataclass(frozen=True)
class PerTetFit:
    """A fitted state, settled."""

    a: Floats  # (n_active, 6) activations of the tets ``active``
    active: Ints  # (n_active,)
    gamma: Floats  # (m,) the muscles' preferred contractions, above 1 where they shorten
    state: PosedFace
    objective: float
    iterations: int  # refused steps and those in viscous flesh, too
    status: Status


def _with_jaw(face: Face, tissue: Tissue, data: Term, options: TetDescentOptions) -> PosedFace:
    """Return the tissue at rest with the jaw where a fit by muscles opens it wide."""
    rest = tissue.face.rest
    try:
        jaw = activation.fit(face, data, unseen_regulariser(face), options=UNSEEN_STOP).state.pose.b
        motion = np.linalg.norm(face.mandible(jaw) - face.mandible(rest.pose.b), axis=1)
        if motion.max() < options.wide_jaw:
            return rest
        return tissue.face.continuation(rest, replace(rest.pose, b=jaw))
    except (SolveError, np.linalg.LinAlgError):
        return rest


def fit(
    face: Face,
    data: Term,
    start: PosedFace | None = None,
    options: PerTetOptions = PER_TET,
    listen: Listener | None = None,
    way: TetDescentOptions = TetDescentOptions(),
) -> PerTetFit:
    """Minimise f from ``start``, a state of another such fit, or from muscles at rest; settle it.

    ``face`` should have the material :data:`~solver.mechanics.flesh.COROTATED_DET`. ``listen``
    hears of equilibria only. Raises :class:`InputError` (``model.no_fibres``, ``model.no_muscle``,
    ``start.activations``) and :class:`SolveError` if the face cannot be settled.
    """
    tissue = tissues.of_face(face)
    state = start or _with_jaw(face, tissue, data, way)
    if state.pose.a.shape != tissue.face.layout.drive.rest.shape:
        raise InputError("start.activations", "the start has not six activations per active tet")
    objective = Objective(tissue, data, options, state.pose.b)
    taken = 0
    value = objective.value(state)
    reachable = np.inf
    for cycle in range(way.cycles):
        if cycle or start is None:
            # half the iterations at most are for the viscous flesh
            left = options.max_iterations - taken
            viscosities = way.viscosities[min(cycle, 1) :]
            steps = min(way.viscous_steps, left // (2 * len(viscosities)))
            state, crept, least = creep(tissue, data, options, state, viscosities, steps, way)
            taken = taken + crept
            reachable = min(reachable, least)
        descent = Descent(objective, state, listen, taken, way, reachable)
        status = descent.run(options.max_iterations, options.tolerance)
        before = value
        (state, value), taken = descent.best, descent.taken
        if status != Status.NO_DESCENT or value > way.enough * before:
            break
    state = tissue.face.solve_equilibrium(state.pose, state.x)
    gamma = objective.priors.contraction.contractions(state.pose.a)
    value = objective.value(state)
    return PerTetFit(state.pose.a, tissue.active, gamma, state, value, taken, status)
