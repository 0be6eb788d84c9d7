"""Activations and jaw frame after frame: what one frame has cost is kept for the next.

A frame takes a few SQP steps in (x, a, b): a Gauss-Newton step of the pose, then corrections of the
equilibrium with the Hessian of a frame or a few ago. The sensitivities are kept for longer still,
as they cost most and an error in them changes the objective to second order only. How well the
steps do what they promise decides about the damping. Where nothing comes of them with new
sensitivities either, the frame is fitted as any expression is, from the frame before; or left at
that, if that is about as good as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose, State
from solver.fitting.gauss_newton import damped_step
from solver.fitting.objective import (
    Regulariser,
    SkinDistance,
    Target,
    Term,
)
from solver.fitting.sensitivity import Jacobian, Sensitivity
from solver.mechanics.equilibrium import CorrectorOptions, correct, untangle
from solver.mechanics.newton import Factorization
from solver.surface import Floats

STEPS = 3
"""SQP steps a frame at most; one that takes them all would like new sensitivities ..."""

KEPT_FRAMES = 15
"""... and gets them once they are this old: where flesh buckles new ones help little."""

HALVINGS = 2
"""How often a step is cut in half before the frame's steps end."""

TOLERANCE = 2e-3
"""A step that gains less than this part of f is not worth taking."""

STUCK = 1.1
"""Growth of f up to which a frame without a way down stays where the frame before was."""

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

    jacobian: Jacobian
    weights: Floats
    hessian: Floats

    @classmethod
    def of(cls, jacobian: Jacobian, data: SkinDistance, x: Floats) -> _Kept:
        """Contract the curvature of a frame's ``data`` with the sensitivities."""
        return cls(jacobian, data.target.weights, jacobian.contract(data.curvature(x)))

    def for_data(self, data: SkinDistance, x: Floats) -> _Kept:
        """Return what suits a frame whose points may be seen otherwise."""
        if np.abs(data.target.weights - self.weights).sum() < RESEEN:
            return self
        return _Kept.of(self.jacobian, data, x)


@dataclass(frozen=True)
class _Found:
    """A frame's state with its f, the steps to it, and whether what is kept led there easily."""

    state: State
    value: float
    steps: int
    easily: bool


class Tracker:
    """Fits the pose of each frame from the one before; ``state`` is the last one's.

    ``temporal`` is the weight w_t of w_t/2 |a - a_before|^2, the change from the frame before (the
    jaw's in the same measure): 0 is none. ``max_iterations`` bounds a frame that is fitted
    as any expression is. A state's vertices are within about :attr:`CorrectorOptions.close_mm` of
    the equilibrium; its factor is that of the frame that was factorised last, its residual is that
    before the last correction.
    """

    def __init__(
        self,
        face: Face,
        regulariser: Regulariser,
        start: State,
        *,
        temporal: float = 0.0,
        max_iterations: int = 20,
    ) -> None:
        self.face = face
        self.state = start
        self._regulariser = regulariser
        self._temporal = temporal
        self._options = ActivationOptions(max_iterations, tolerance=1e-3)
        self._kept: _Kept | None = None
        self._age = 0
        self._value = np.inf
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
            if found is None and self._age:
                found = self._quick(self._keep(data), data, regulariser)
            value = activation.objective(data, regulariser, self.state)
            if found is None and value < STUCK * self._value:
                return 0
        if found is None:
            fitted = activation.fit(
                self.face,
                data,
                regulariser,
                self.state,
                self._options,
                matrix=None if self._kept is None else self._kept.hessian,
            )
            found = _Found(fitted.state, fitted.objective, fitted.iterations, easily=False)
            self._age = KEPT_FRAMES
        self.state, self._value = found.state, found.value
        self._age += 1
        if not found.easily and self._age >= KEPT_FRAMES:
            self._keep(data)
        return found.steps

    def _keep(self, data: SkinDistance) -> _Kept:
        """Take the Hessian and the sensitivities of the state as it is."""
        pose, found = self.state.pose, self.state.equilibrium
        # what was projected, too, would be wrong in every frame that it is kept for
        if (
            found.factor.projection > 0
            or np.abs(found.factor.x - found.x).max() > CorrectorOptions.close_mm
        ):
            a = self.face.tet_activations(pose.a)
            factorization = Factorization(self.face.flesh, self.face.linear, found.x, a)
            self.state = State(pose, replace(found, factor=factorization))
        jacobian = Sensitivity(self.face, self.state).by_pose()
        self._kept = _Kept.of(jacobian, data, self.state.x)
        self._age = 0
        return self._kept

    def _quick(self, kept: _Kept, data: Term, regulariser: Regulariser) -> _Found | None:
        """Fit a frame with what is kept; None if the first step leads nowhere."""
        state = self.state
        value = activation.objective(data, regulariser, state)
        for taken in range(STEPS):
            gradient = kept.jacobian.adjoint(data.gradient(state.x))
            gradient += regulariser.gradient(state.pose)
            hessian = kept.hessian + regulariser.gauss_newton(state.pose)
            step = damped_step(state.pose.layout, hessian, gradient, self._damping, trust=1.0)
            slope, bend = float(gradient @ step), float(step @ hessian @ step)
            if -slope - 0.5 * bend <= TOLERANCE * value:
                return _Found(state, value, taken, easily=True)
            part = 1.0
            for _ in range(HALVINGS + 1):
                trial = self._moved(kept, state, part * step)
                if trial is not None:
                    reached = activation.objective(data, regulariser, trial)
                    if reached < value:
                        break
                part *= 0.5
                self._damping = min(self._damping * DAMPING_GROWTH, DAMPING_MOST)
            else:
                return _Found(state, value, taken, easily=False) if taken else None
            ratio = (value - reached) / (-part * slope - 0.5 * part**2 * bend)
            state, value = trial, reached
            self._adapt(ratio)
            if ratio < HARDLY:
                return _Found(state, value, taken + 1, easily=False)
        return _Found(state, value, STEPS, easily=False)

    def _moved(self, kept: _Kept, state: State, step: Floats) -> State | None:
        """Return the state a step of the pose leads to, None if it is far."""
        pose = state.pose.add(step)
        x = self.face.flesh.moved(state.x, kept.jacobian.flesh @ step)
        x[self.face.model.mandible] = self.face.mandible(pose.b)
        flesh, a = self.face.flesh, self.face.tet_activations(pose.a)
        guess = untangle(flesh, state.x, x)
        if guess is None:
            return None
        found = correct(flesh, self.face.linear, guess, a, state.equilibrium.factor)
        return None if found is None else State(pose, found)

    def _adapt(self, ratio: float) -> None:
        """Take back or add damping, as a step gained ``ratio`` of what was predicted."""
        if ratio > WELL:
            self._damping = max(self._damping / DAMPING_GROWTH, DAMPING_LEAST)
        elif ratio < BADLY:
            self._damping = min(self._damping * DAMPING_GROWTH, DAMPING_MOST)


# How still each point of the face lies on the skull, by the model's own mechanics.


EXCITED = 0.2
"""Change of an activation's entry that counts as usual."""
JAW_MOTION = np.array([0.2, 0.1, 3.0, 3.0, 3.0])
"""Usual motion of the jaw, rad and mm."""
MOBILE_MM = 0.4
"""Motion that halves a point's stillness."""


def stillness(face: Face) -> Floats:
    """Return weights (k,) in (0, 1] of the face's points: 1 where no muscle nor the jaw moves it.

    The motion is the linear response, at rest, to usual changes of every activation and of the
    jaw, all at once and independent of each other.
    """
    by_pose = Sensitivity(face, face.rest_state()).motions_by_pose()
    usual = face.layout.join([np.full_like(face.rest_pose().a, EXCITED), JAW_MOTION])
    columns = (by_pose * usual).reshape(len(by_pose), -1)
    motion = np.asarray(face.face_embedding @ columns)
    squares = np.sum(motion.reshape(len(motion), -1) ** 2, axis=1)
    return np.asarray(1.0 / (1.0 + squares / MOBILE_MM**2) ** 2)
