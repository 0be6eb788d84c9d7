"""(P): six activations in every tet with muscle, the model that muscle geometry is compared with.

    f(a, b) = data(x) + w_act R_act(a) + w_sparse R_sparse(a)
              + w_volume sum_i v_i (det S(a_i) - 1)^2 + w_b/2 |D (b - b_start)|^2

with x the equilibrium of active and passive tissue (:mod:`solver.fitting.tissue`) and v_i tet i's
part of all muscle volume, so that no weight depends on the mesh's resolution (Ichim et al., Phace,
SIGGRAPH 2017). Reduced-space Gauss-Newton as in :mod:`solver.fitting.activation`: x is eliminated.
Before each step for (a, b) every muscle's contraction is found for the activations at hand (local),
then a and b are solved for together (global).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting import stretches
from solver.fitting import tissue as tissues
from solver.fitting.contraction import PreferredContraction
from solver.fitting.face import Face, Pose, State
from solver.fitting.group_sparsity import GroupSparsity
from solver.fitting.objective import JAW_UNITS, determinant_gradients, determinants
from solver.fitting.saddle import Quadratic, Response, SaddleSolver
from solver.fitting.terms import Term
from solver.fitting.tissue import Tissue
from solver.mechanics import equilibrium
from solver.mechanics.flesh import IDENTITY, Material
from solver.surface import Floats, Ints

PHACE = Material(mu=1.0, lam=0.0, kappa=3.0)
"""The flesh as published: mu |F - R S(a)|^2 + 3 mu (det F - det S(a))^2."""

LARGEST_STEP = 0.5
LARGEST_JAW_STEP = 2.0
"""How far the linear model is trusted: a tet's change |dS(a_i)|, relative, and the jaw's in mm."""

DAMPING_START = 1.0
JAW_DAMPING_START = 1e-2
DAMPING_LEAST = 1e-7
DAMPING_FALL = 0.25
DAMPING_GROWTH = 8.0
"""By what a damping falls and grows at most from step to step."""

DAMPING_REFUSED = 16.0
"""By what all dampings grow when a step and its half are refused."""

HALVINGS = 2
SNAPS = 6
SNAP_LOSS = 2.5
"""How often a fit may snap over a fold, and to what multiple of the least f."""

SMALL_GAINS = 2
"""Steps one after the other that gain next to nothing; a single one may just have been damped."""

UNSTUCK = 0.02
"""Gain, as a part of f, after which a refused step is forgotten; less is creeping."""

PATIENCE = 6
"""Iterations without a new least f before it counts as the minimum."""


CORRECTIONS = 8
SNAP_ITERATIONS = 30
"""Newton steps to an equilibrium nearby and to one behind a fold."""


@dataclass(frozen=True)
class PerTetOptions:
    """Weights of the regularisers, and when to stop.

    ``w_act``, ``w_sparse`` and ``w_volume`` are in mm^2, ``w_b`` weighs the jaw's change. The fit
    ends after ``max_iterations`` or when steps gain less than ``tolerance`` f.
    """

    w_act: float = 0.01
    w_sparse: float = 1e-3
    w_volume: float = 10.0
    w_b: float = 1e-6
    max_iterations: int = 40
    tolerance: float = 2e-3


class Status(StrEnum):
    """Why a fit ended."""

    CONVERGED = "converged"
    NO_DESCENT = "no descent"
    ITERATIONS = "iterations"


@dataclass(frozen=True)
class PerTetFit:
    """A fitted state, settled.

    ``a`` (n_active, 6) are the activations of the tets ``active`` (n_active,), ``gamma`` (m,) the
    muscles' preferred contractions, above 1 where they shorten. ``iterations`` counts steps,
    refused ones too.
    """

    a: Floats
    active: Ints
    gamma: Floats
    state: State
    objective: float
    iterations: int
    status: Status


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt damping, one of each active tet, ``tets`` (n_active,), and the ``jaw``'s.

    The flesh may need ten times more of one tet than of another: with dampings of their own no
    activation outruns the linear model, and none waits for others. They fall to no less than
    ``fall`` times themselves a step, and more slowly after every refused step.
    """

    tets: Floats
    jaw: float
    fall: float = DAMPING_FALL

    @classmethod
    def start(cls, count: int) -> Damping:
        """Return the damping of the first step."""
        return cls(np.full(count, DAMPING_START), JAW_DAMPING_START)

    def limited(self, at: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats, Damping]:
        """Cut a step (a, b) from activations ``at`` tet by tet; return it and the next damping."""
        length = np.sqrt(np.einsum("ei,eij,ej->e", a, stretches.metric(at), a)) / LARGEST_STEP
        jaw = float(np.abs(JAW_UNITS * b).max()) / LARGEST_JAW_STEP
        tets = self.tets * np.clip(length, self.fall, DAMPING_GROWTH)
        damping = Damping(
            np.maximum(tets, DAMPING_LEAST),
            max(self.jaw * min(max(jaw, self.fall), DAMPING_GROWTH), DAMPING_LEAST),
            self.fall,
        )
        return a / np.maximum(length, 1.0)[:, None], b / max(jaw, 1.0), damping

    def raised(self, factor: float) -> Damping:
        """Return this damping times ``factor``."""
        return Damping(factor * self.tets, factor * self.jaw, self.fall)

    @property
    def hindered(self) -> bool:
        """Tell whether small gains may be the damping's doing."""
        return self.fall > DAMPING_FALL

    def afresh(self) -> Damping:
        """Return this damping without the memory of refused steps."""
        return Damping(self.tets, self.jaw)

    def after_refusal(self) -> Damping:
        """Return the damping to try again with."""
        raised = self.raised(DAMPING_REFUSED)
        return Damping(raised.tets, raised.jaw, float(np.sqrt(self.fall)))


Listener = Callable[[int, float], None]
"""Called after each accepted step with the iteration and the least objective so far."""


class Objective:
    """f as a function of a tissue's state, with its derivatives."""

    def __init__(self, tissue: Tissue, data: Term, options: PerTetOptions, b: Floats) -> None:
        self.tissue = tissue
        self._data = data
        self._options = options
        self._b = b
        self._volumes = tissue.volumes
        self._contraction = PreferredContraction(tissue)
        self._sparsity = GroupSparsity(tissue)

    def contractions(self, a: Floats) -> Floats:
        """Return the muscles' gamma (m,) that minimise f at activations ``a``."""
        return self._contraction.contractions(a)

    def value(self, state: State) -> float:
        """Return f at a state's estimate, every gamma being the best."""
        return self._data.value(state.estimate) + self.prior_value(state.pose)

    def prior_value(self, pose: Pose) -> float:
        """Return the regularisers' sum at a pose."""
        options, a = self._options, pose.a
        det = determinants(a) - 1.0
        jaw = JAW_UNITS * (pose.b - self._b)
        return float(
            options.w_act * self._contraction.value(a, self.contractions(a))
            + options.w_sparse * self._sparsity.value(a)
            + options.w_volume * (self._volumes @ det**2)
            + 0.5 * options.w_b * jaw @ jaw
        )

    def prior_gradient(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return the derivatives of :meth:`prior_value` by a, (n_active, 6), and by b, (5,)."""
        options, a = self._options, pose.a
        by_a = options.w_act * self._contraction.gradient(a, self.contractions(a))
        by_a = by_a + options.w_sparse * self._sparsity.gradient(a)
        stretch = 2.0 * options.w_volume * self._volumes * (determinants(a) - 1.0)
        by_a = by_a + stretch[:, None] * determinant_gradients(a)
        return by_a, options.w_b * JAW_UNITS**2 * (pose.b - self._b)

    def prior_blocks(self, a: Floats) -> Floats:
        """Return the Gauss-Newton Hessian of :meth:`prior_value` by each tet's a, (n_active, 6, 6).

        The contractions are held, and the parabolas of R_sparse stand for it.
        """
        options, slopes = self._options, determinant_gradients(a)
        volume = 2.0 * options.w_volume * self._volumes
        blocks = volume[:, None, None] * slopes[:, :, None] * slopes[:, None, :]
        diagonal = options.w_act * self._contraction.curvature()
        blocks[:, np.arange(6), np.arange(6)] += diagonal
        blocks[:, np.arange(6), np.arange(6)] += options.w_sparse * self._sparsity.curvature(a)
        return np.asarray(blocks)

    def quadratic(self, state: State, damping: Damping) -> Quadratic:
        """Return the Gauss-Newton model of f at a state, damped."""
        options, a = self._options, state.pose.a
        response = Response(self.tissue, state)
        by_a, by_b = response.transposed(self._data.gradient(state.estimate).ravel())
        prior_by_a, prior_by_b = self.prior_gradient(state.pose)
        blocks = self.prior_blocks(a)
        blocks += 2.0 * (damping.tets * self._volumes)[:, None, None] * stretches.metric(a)
        return Quadratic(
            response,
            (by_a + prior_by_a, by_b + prior_by_b),
            self._data.curvature(state.estimate),
            blocks,
            (options.w_b + damping.jaw) * JAW_UNITS**2,
        )


def fit(
    face: Face,
    data: Term,
    start: State | None = None,
    options: PerTetOptions | None = None,
    listen: Listener | None = None,
) -> PerTetFit:
    """Minimise f from ``start``, a state of another such fit or the neutral face, and settle it.

    ``face`` should have the material :data:`PHACE`. Raises :class:`InputError`
    (``model.no_fibres``, ``model.no_muscle``, ``start.activations``) and :class:`SolveError` if the
    face can not be settled.
    """
    options = options or PerTetOptions()
    tissue = tissues.of_face(face)
    state = start or rest_state(tissue)
    if state.pose.a.shape != (len(tissue.active), 6):
        raise InputError("start.activations", "the start has not six activations per active tet")
    objective = Objective(tissue, data, options, state.pose.b)
    found = _improve(objective, state, options, listen)
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


def rest_state(tissue: Tissue) -> State:
    """Return the neutral face with passive flesh."""
    pose = Pose(np.tile(IDENTITY, (len(tissue.active), 1)), np.zeros(5))
    return tissue.face.settle(tissue.selection, pose, tissue.face.model.rest)


@dataclass(frozen=True)
class _Improved:
    state: State
    value: float
    iterations: int
    status: Status


def _improve(
    objective: Objective, state: State, options: PerTetOptions, listen: Listener | None
) -> _Improved:
    """Minimise f, going from equilibrium to equilibrium; where the flesh folds, over the fold.

    At a fold no short step helps: the flesh snaps into another equilibrium, where f may at first be
    higher. The best state of all is kept.
    """
    value = objective.value(state)
    best = state, value
    solver = SaddleSolver(objective.tissue)
    damping = Damping.start(len(objective.tissue.active))
    stuck = slow = False
    snaps = since_best = small = 0
    for iteration in range(1, options.max_iterations + 1):
        creeps = slow and damping.hindered
        if creeps:
            damping = Damping.start(len(objective.tissue.active))
        model = objective.quadratic(state, damping)
        a, b, lowered = damping.limited(state.pose.a, *solver.step(model, state))
        trial, halvings = (None, 0) if creeps else _shortened(objective, model, state, value, a, b)
        since_best += 1
        if trial is None and not (stuck or creeps):
            stuck, damping = True, damping.after_refusal()
            continue
        if trial is None and snaps < SNAPS:
            stuck, snaps = False, snaps + 1
            trial = _snapped(objective, state, SNAP_LOSS * best[1], a, b)
            lowered = lowered.afresh()
        if trial is None:
            return _Improved(*best, iteration, Status.NO_DESCENT)
        damping = lowered.raised(2.0**halvings)
        gain, value, state = value - objective.value(trial), objective.value(trial), trial
        slow = 0.0 <= gain < UNSTUCK * value
        stuck = stuck and slow
        small = small + 1 if 0.0 <= gain <= options.tolerance * value else 0
        if value < best[1]:
            best, since_best = (state, value), 0
        if listen:
            listen(iteration, best[1])
        if small == SMALL_GAINS:
            return _Improved(*best, iteration, Status.CONVERGED)
        if since_best == PATIENCE:
            return _Improved(*best, iteration, Status.NO_DESCENT)
    return _Improved(*best, options.max_iterations, Status.ITERATIONS)


def _snapped(
    objective: Objective, state: State, limit: float, a: Floats, b: Floats
) -> State | None:
    """Return the equilibrium at the end of the step (a, b), however far that is, if f < ``limit``.

    Half the step is tried where the whole one leads nowhere.
    """
    for part in (1.0, 0.5):
        pose = Pose(stretches.moved(state.pose.a, part * a), state.pose.b + part * b)
        try:
            found = _settled(objective.tissue, pose, state.x, SNAP_ITERATIONS)
        except SolveError:
            continue
        if found.equilibrium.minimum and objective.value(found) < limit:
            return found
    return None


def _shortened(
    objective: Objective, model: Quadratic, state: State, value: float, a: Floats, b: Floats
) -> tuple[State | None, int]:
    """Return the first state along the step (a, b), halved and halved, with a lower f."""
    for halving in range(HALVINGS):
        part = 0.5**halving
        pose = Pose(stretches.moved(state.pose.a, part * a), state.pose.b + part * b)
        motion = model.response.motion(pose.a - state.pose.a, pose.b - state.pose.b)
        try:
            trial = _reach(objective.tissue, state, motion[model.response.free], pose)
        except SolveError:
            continue
        if trial.equilibrium.minimum and objective.value(trial) < value:
            return trial, halving
    return None, HALVINGS


def _reach(tissue: Tissue, state: State, response: Floats, pose: Pose) -> State:
    """Go from ``state`` to the equilibrium of a pose nearby; raises :class:`SolveError`.

    Approaching is not enough here: single tets are so soft that the flesh may buckle on the rest of
    the way, and the derivatives would be those of another equilibrium.
    """
    near = tissue.face.approach(tissue.selection, state, response, pose)
    return _settled(tissue, pose, near.x, CORRECTIONS)


def _settled(tissue: Tissue, pose: Pose, x: Floats, iterations: int) -> State:
    """Find the equilibrium of a pose from ``x`` within so many Newton steps."""
    x = x.copy()
    x[tissue.face.model.mandible] = tissue.face.mandible(pose.b)
    found = equilibrium.solve(
        tissue.face.flesh,
        tissue.face.linear,
        x,
        tissue.face.tet_activations(tissue.selection, pose.a),
        tolerance=tissue.face.tolerance,
        max_iterations=iterations,
    )
    return State(pose, found)
