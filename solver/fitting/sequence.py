"""Activations and jaw frame after frame: what one frame has cost is kept for the next.

A frame takes a few SQP steps in (x, a, b): a Gauss-Newton step of the pose, then corrections of the
equilibrium with the Hessian of a frame or a few ago. The sensitivities are kept for longer still,
as they cost most and an error in them changes the objective to second order only. How well the
steps do what they promise decides about the damping. Where nothing comes of them with new
sensitivities either, the frame is fitted as any expression is, from the frame before; or left at
that, if that is about as good as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions, damped_step
from solver.fitting.controls import Layout
from solver.fitting.face import Face, Pose, State
from solver.fitting.least_squares import (
    DampingOptions,
    Ending,
    Halving,
    LeastSquaresStep,
    StopOptions,
    minimise,
)
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term
from solver.fitting.sensitivity import Jacobian, Sensitivity
from solver.mechanics.equilibrium import CorrectorOptions, correct, untangle
from solver.mechanics.newton import Factorization
from solver.surface import Floats


@dataclass(frozen=True)
class TrackingOptions:
    """The steps of a frame, and when what is kept is made anew."""

    # SQP steps at most (a frame that takes them all would like new sensitivities), and the part
    # of f that a step has to promise
    stop: StopOptions = field(default_factory=lambda: StopOptions(3, promised=2e-3))
    least_ratio: float = 0.2  # of a gain to the promised one, below which the frame's steps end
    damping: DampingOptions = field(
        default_factory=lambda: DampingOptions(1e-3, least=1e-4, most=1.0, good=0.7, bad=0.4)
    )
    # age in frames before sensitivities are made anew: where flesh buckles new ones help little
    kept_frames: int = 15
    stuck: float = 1.1  # growth of f up to which a frame without a way down stays as it was
    reseen: float = 0.1  # part of the points' weight that moves before a matrix is made anew


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

    def for_data(self, data: SkinDistance, x: Floats, reseen: float) -> _Kept:
        """Return what suits a frame whose points may be seen otherwise."""
        if np.abs(data.target.weights - self.weights).sum() < reseen:
            return self
        return _Kept.of(self.jacobian, data, x)


@dataclass(frozen=True)
class _Found:
    """A frame's state with its f, the steps to it, and whether what is kept led to convergence."""

    state: State
    value: float
    steps: int
    converged: bool


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
        options: TrackingOptions | None = None,
    ) -> None:
        self.face = face
        self.state = start
        self._regulariser = regulariser
        self._temporal = temporal
        self._whole_fit = ActivationOptions(max_iterations, tolerance=1e-3)
        self._options = options or TrackingOptions()
        self._kept: _Kept | None = None
        self._age = 0
        self._value = np.inf
        self._search = Halving(self._options.damping, least_ratio=self._options.least_ratio)

    def fit(self, target: Target, before: Pose | None = None) -> int:
        """Fit a frame and return the steps it took.

        ``before`` is the frame before's pose, where the state is this frame's already: fitted to
        another placing of the head.

        Raises :class:`SolveError` if it cannot be fitted; the state stays that of the frame
        before.
        """
        data = SkinDistance(self.face, target)
        regulariser = self._regulariser.drawn_to(before or self.state.pose, self._temporal)
        found = None
        if self._kept:
            self._kept = self._kept.for_data(data, self.state.x, self._options.reseen)
            found = self._quick(self._kept, data, regulariser)
            if found is None and self._age:
                found = self._quick(self._keep(data), data, regulariser)
            value = activation.objective(data, regulariser, self.state)
            if found is None and value < self._options.stuck * self._value:
                return 0
        if found is None:
            fitted = activation.fit(
                self.face,
                data,
                regulariser,
                self.state,
                self._whole_fit,
                matrix=None if self._kept is None else self._kept.hessian,
            )
            found = _Found(fitted.state, fitted.objective, fitted.iterations, converged=False)
            self._age = self._options.kept_frames
        self.state, self._value = found.state, found.value
        self._age += 1
        if not found.converged and self._age >= self._options.kept_frames:
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
        problem = _FrameProblem(self.face, kept, data, regulariser)
        found = minimise(problem, self.state, self._search, self._options.stop)
        if found.ending == Ending.STUCK and not found.steps:
            return None
        converged = found.ending == Ending.CONVERGED
        return _Found(found.point, found.value, found.steps, converged)


@dataclass(frozen=True)
class _FrameModel:
    """f's model by the sensitivities that are kept."""

    layout: Layout
    gradient: Floats
    hessian: Floats

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """See :class:`~solver.fitting.least_squares.LinearModel`."""
        step = damped_step(self.layout, self.hessian, self.gradient, damping, trust)
        slope, bend = float(self.gradient @ step), float(step @ self.hessian @ step)
        return LeastSquaresStep(step, slope, bend, self.layout.reach(step))


@dataclass(frozen=True)
class _FrameProblem:
    """f of a frame by what is kept: a :class:`~solver.fitting.least_squares.Problem`."""

    face: Face
    kept: _Kept
    data: Term
    regulariser: Regulariser

    def value(self, point: State) -> float:
        """See :class:`Problem`."""
        return activation.objective(self.data, self.regulariser, point)

    def linearise(self, point: State) -> _FrameModel:
        """See :class:`Problem`."""
        gradient = self.kept.jacobian.adjoint(self.data.gradient(point.x))
        gradient += self.regulariser.gradient(point.pose)
        hessian = self.kept.hessian + self.regulariser.gauss_newton(point.pose)
        return _FrameModel(point.pose.layout, gradient, hessian)

    def move(self, point: State, step: LeastSquaresStep) -> State | None:
        """See :class:`Problem`; the equilibrium is only corrected."""
        face, flesh, pose = self.face, self.face.flesh, point.pose.add(step.change)
        x = flesh.moved(point.x, self.kept.jacobian.flesh @ step.change)
        x[face.model.mandible] = face.mandible(pose.b)
        guess = untangle(flesh, point.x, x)
        if guess is None:
            return None
        a = face.tet_activations(pose.a)
        found = correct(flesh, face.linear, guess, a, point.equilibrium.factor)
        return None if found is None else State(pose, found)


# How still each point of the face lies on the skull, by the model's own mechanics.


@dataclass(frozen=True)
class UsualMotion:
    """Changes of the pose that count as usual, and a motion that makes a point mobile."""

    activation: float = 0.2  # of an entry
    jaw: tuple[float, ...] = (0.2, 0.1, 3.0, 3.0, 3.0)  # rad and mm
    mobile_mm: float = 0.4  # of a point that is half as still as the skull


def stillness(face: Face, usual: UsualMotion = UsualMotion()) -> Floats:
    """Return weights (k,) in (0, 1] of the face's points: 1 where no muscle nor the jaw moves it.

    The motion is the linear response, at rest, to usual changes of every activation and of the
    jaw, all at once and independent of each other.
    """
    sensitivity = Sensitivity(face, face.rest)
    by_pose = sensitivity.response.motions(sensitivity.pose)
    by_a = np.full_like(face.rest_pose().a, usual.activation)
    change = face.layout.join([by_a, np.array(usual.jaw)])
    columns = (by_pose * change).reshape(len(by_pose), -1)
    motion = np.asarray(face.face_embedding @ columns)
    squares = np.sum(motion.reshape(len(motion), -1) ** 2, axis=1)
    return np.asarray(1.0 / (1.0 + squares / usual.mobile_mm**2) ** 2)
