"""Activations and jaw frame after frame: what one frame has cost is kept for the next.

A frame takes a few SQP steps in (x, a, b): a Gauss-Newton step of the pose, then Newton corrections
of the equilibrium. The stiffness is that of a frame or a few ago, factorised anew where corrections
do not get shorter; the sensitivities are kept for longer still, as they cost most and an error in
them changes the objective to second order only. How well the steps do what they promise decides
about the damping. Where nothing comes of them the frame is fitted as any expression is, from the
frame before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions, damped_step
from solver.fitting.face import Face, Pose, State
from solver.fitting.objective import Regulariser, Target
from solver.fitting.sensitivity import PoseJacobian, Sensitivity
from solver.fitting.terms import SkinDistance, Term
from solver.mechanics import equilibrium
from solver.mechanics.equilibrium import Equilibrium
from solver.surface import Floats

STEPS = 3
"""SQP steps a frame at most; one that takes them all would like new sensitivities ..."""

KEPT_FRAMES = 15
"""... and gets them once they are this old: where flesh buckles new ones help little."""

HALVINGS = 2
"""How often a step is cut in half before the frame's steps end."""

TOLERANCE = 2e-3
"""A step that gains less than this part of f is not worth taking."""

LONG_MM, CLOSE_MM = 0.75, 0.2
"""After a longer correction Newton's method takes over; the end of a shorter one is good enough."""

CONTRACTION = 0.5
"""So it does after one that is not shorter than this part of the one before."""

CORRECTIONS = 6

DAMPING_START, DAMPING_LEAST, DAMPING_MOST = 1e-3, 1e-4, 1.0
DAMPING_GROWTH = 4.0

RESEEN = 0.1
"""Part of the points' weight that moves elsewhere before a kept matrix is made anew."""

WELL, BADLY, HARDLY = 0.7, 0.4, 0.2
"""Gains, as parts of the predicted: damping falls, damping grows, the frame's steps end."""


@dataclass(frozen=True)
class _Kept:
    """Sensitivities of a frame before, and the pose's Gauss-Newton matrix without regulariser.

    The matrix is that of points with ``weights`` (k,).
    """

    jacobian: PoseJacobian
    weights: Floats
    hessian: Floats

    @classmethod
    def of(cls, jacobian: PoseJacobian, data: SkinDistance, x: Floats) -> _Kept:
        """Contract the curvature of a frame's ``data`` with the sensitivities."""
        return cls(jacobian, data.target.weights, jacobian.contracted(data.curvature(x)))

    def for_data(self, data: SkinDistance, x: Floats) -> _Kept:
        """Return what suits a frame whose points may be seen otherwise."""
        if np.abs(data.target.weights - self.weights).sum() < RESEEN:
            return self
        return _Kept.of(self.jacobian, data, x)


@dataclass(frozen=True)
class _Found:
    """A frame's state, the steps to it, and whether what is kept led there as it promised."""

    state: State
    steps: int
    easily: bool


class Tracker:
    """Fits the pose of each frame from the one before; ``state`` is the last one's.

    ``temporal`` is the weight w_t of w_t/2 |a - a_before|^2, the change from the frame before (the
    jaw's in the same measure): 0 is none. ``max_iterations`` bounds a frame that is fitted
    as any expression is. A state's vertices are within about :data:`CLOSE_MM` of the equilibrium;
    its factor and ``minimum`` are those of the frame that was factorised last, its residual is that
    before the last correction.
    """

    def __init__(
        self,
        face: Face,
        S: sp.csr_array,
        regulariser: Regulariser,
        start: State,
        *,
        temporal: float = 0.0,
        max_iterations: int = 20,
    ) -> None:
        self.face = face
        self.state = start
        self._S = S
        self._regulariser = regulariser
        self._temporal = temporal
        self._thorough = ActivationOptions(max_iterations, tolerance=1e-3)
        self._kept: _Kept | None = None
        self._age = 0
        self._damping = DAMPING_START

    def fit(self, target: Target, before: Pose | None = None) -> int:
        """Fit a frame and return the steps it took.

        ``before`` is the frame before's pose, where the state is this frame's already: fitted to
        another placing of the head.

        Raises :class:`SolveError` if it can not be fitted; the state stays that of the frame
        before.
        """
        data = SkinDistance(self.face, target)
        regulariser = self._regulariser.drawn_to(before or self.state.pose, self._temporal)
        found = None
        if self._kept:
            self._kept = self._kept.for_data(data, self.state.x)
            found = self._quick(self._kept, data, regulariser)
        if found is None:
            fitted = activation.fit(
                self.face, self._S, data, regulariser, self.state, self._thorough
            )
            self.state, steps = fitted.state, fitted.iterations
            self._keep(data)
            return steps
        self.state = found.state
        self._age += 1
        if not found.easily and self._age >= KEPT_FRAMES:
            self._keep(data)
        return found.steps

    def _keep(self, data: SkinDistance) -> None:
        """Take the sensitivities of the state as it is."""
        jacobian = Sensitivity(self.face, self._S, self.state).by_pose()
        self._kept = _Kept.of(jacobian, data, self.state.x)
        self._age = 0

    def _quick(self, kept: _Kept, data: Term, regulariser: Regulariser) -> _Found | None:
        """Fit a frame with what is kept; None if the first step leads nowhere."""
        state = self.state
        value = activation.objective(data, regulariser, state)
        for taken in range(STEPS):
            gradient = kept.jacobian.transposed(data.gradient(state.x))
            gradient += regulariser.gradient(state.pose)
            hessian = kept.hessian + regulariser.gauss_newton(state.pose)
            step = damped_step(hessian, gradient, self._damping, trust=1.0)
            predicted = float(-gradient @ step - 0.5 * step @ hessian @ step)
            if predicted <= TOLERANCE * value:
                return _Found(state, taken, easily=True)
            trial = self._descend(kept, data, regulariser, state, step, value)
            if trial is None:
                return _Found(state, taken, easily=False) if taken else None
            before, (state, value) = value, trial
            ratio = (before - value) / predicted
            self._adapt(ratio)
            if ratio < HARDLY:
                return _Found(state, taken + 1, easily=False)
        return _Found(state, STEPS, easily=False)

    def _descend(
        self,
        kept: _Kept,
        data: Term,
        regulariser: Regulariser,
        state: State,
        step: Floats,
        value: float,
    ) -> tuple[State, float] | None:
        """Return the state a step or part of it leads to with its f, if that is below ``value``."""
        for _ in range(HALVINGS + 1):
            pose = Pose(state.pose.a + step[:-5].reshape(-1, 6), state.pose.b + step[-5:])
            x = state.x.copy()
            x[self.face.flesh.free] += (kept.jacobian.flesh @ step).reshape(-1, 3)
            x[self.face.model.mandible] = self.face.mandible(pose.b)
            trial = self._corrected(pose, x, state.equilibrium)
            if trial is not None:
                reached = activation.objective(data, regulariser, trial)
                if reached < value:
                    return trial, reached
            step = 0.5 * step
            self._damping = min(self._damping * DAMPING_GROWTH, DAMPING_MOST)
        return None

    def _adapt(self, ratio: float) -> None:
        """Take back or add damping, as a step gained ``ratio`` of what was predicted."""
        if ratio > WELL:
            self._damping = max(self._damping / DAMPING_GROWTH, DAMPING_LEAST)
        elif ratio < BADLY:
            self._damping = min(self._damping * DAMPING_GROWTH, DAMPING_MOST)

    def _corrected(self, pose: Pose, x: Floats, before: Equilibrium) -> State | None:
        """Return the equilibrium of a pose from a prediction x near it; None if it is far.

        By Newton corrections with the factor of ``before`` as long as they get shorter, else by
        Newton's method.
        """
        flesh = self.face.flesh
        a = self.face.tet_activations(self._S, pose.a)
        bound = LONG_MM
        for number in range(CORRECTIONS):
            gradient = flesh.gradient(x, a)
            direction = -before.factor.solve(gradient)
            length = float(np.abs(direction).max())
            if not length <= bound:
                break
            x = x.copy()
            x[flesh.free] += direction.reshape(-1, 3)
            if length <= CLOSE_MM:
                if not np.isfinite(flesh.energy(x, a)):
                    return None
                residual = float(np.linalg.norm(gradient)) / flesh.force_scale
                found = replace(before, x=x, estimate=x, residual=residual, iterations=number)
                return State(pose, found)
            bound = CONTRACTION * length
        try:
            found = equilibrium.approach(flesh, self.face.linear, x, a)
        except SolveError:
            return None
        if np.isfinite(flesh.energy(found.estimate, a)):
            found = replace(found, x=found.estimate)
        return State(pose, found)
