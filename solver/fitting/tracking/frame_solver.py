"""Fit a frame from the one before, by derivatives that lag behind.

A frame takes a few SQP steps in (x, a, b): a Gauss-Newton step of the pose, then corrections of the
equilibrium with the Hessian of a frame or a few ago. The sensitivities lag for longer still,
as they cost most and an error in them changes the objective to second order only; they learn from
steps what they miss (:mod:`.lagged`). Where nothing comes of new sensitivities either, the frame is
fitted as any expression is, from the frame before; or left at that, if that is about as good as it
was.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions, DenseModel, DescentOptions
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.least_squares import (
    Backtracking,
    DampingOptions,
    LeastSquaresSolution,
    LeastSquaresStep,
    StopOptions,
    Termination,
    minimise,
)
from solver.fitting.objective import Prior, SumTerm, Term
from solver.fitting.sensitivity import Jacobian, Sensitivity
from solver.fitting.steps import FeasibleStepOptions
from solver.fitting.tracking.lagged import LaggedModel, SecantOptions
from solver.mechanics.equilibrium import CorrectorOptions, correct, untangle
from solver.mechanics.newton import Factorization
from solver.surface import Floats


@dataclass(frozen=True)
class TrackingOptions:
    """The steps of a frame, and when what lags is made anew."""

    # SQP steps at most, the part of f that a step has to promise, and the part of f that one has to
    # gain for another one to be tried
    stop: StopOptions = field(default_factory=lambda: StopOptions(3, promised=2e-2, gained=0.1))
    least_ratio: float = 0.2  # of a gain to the promised one, below which the frame's steps end
    damping: DampingOptions = field(
        default_factory=lambda: DampingOptions(1e-3, least=1e-4, most=1.0, good=0.7, bad=0.4)
    )
    # age in frames before which a frame whose steps gain less than they promise gets no new
    # sensitivities: where flesh buckles these help little ...
    lagged_frames: int = 15
    stale_frames: int = 90  # ... and one that takes all its steps gets none
    secants: SecantOptions | None = field(default_factory=SecantOptions)  # None: nothing is learned
    corrector: CorrectorOptions = field(default_factory=CorrectorOptions)
    steps: FeasibleStepOptions = field(default_factory=FeasibleStepOptions.quick)  # within bounds
    # effort of a frame that is fitted as any expression is
    whole: ActivationOptions = field(default_factory=lambda: ActivationOptions(20, tolerance=1e-3))
    stuck: float = 1.1  # growth of f up to which a frame without a way down stays as it was
    reseen: float = 0.1  # part of the points' weight that moves before a matrix is made anew


class FrameSolver:
    """Fits the pose of each frame from the one before; ``state`` is the last one's.

    A state's vertices are within about the corrector's ``close_mm`` of the equilibrium; its factor
    is that of the frame that was factorised last, its residual that before the last correction.
    """

    def __init__(
        self, face: Face, start: PosedFace, options: TrackingOptions = TrackingOptions()
    ) -> None:
        self.face = face
        self.state = start
        self._options = options
        self._descent = DescentOptions(steps=options.steps)
        self._lagged: LaggedModel | None = None
        self._age = 0
        self._expired = False
        self._value = np.inf
        self._search = Backtracking(options.damping, least_ratio=options.least_ratio)

    def fit(
        self,
        data: Term,
        weights: Floats,
        prior: Prior,
        *,
        contact: Term | None = None,
        whole: bool = False,
    ) -> int:
        """Fit a frame by any term and return the steps it took.

        ``weights`` (k,) are what its curvature depends on, all of it in the same measure: where
        they change by much, the lagged matrix is made anew. ``contact`` comes and goes from one
        state to the next: its curvature is always that of the state. A ``whole`` fit is that of any
        expression, for a frame far from the state. Raises :class:`SolveError` if the frame
        cannot be fitted; the state stays that of the frame before.
        """
        options = self._options
        lagged = self._lagged
        both = data if contact is None else SumTerm((data, contact))
        found = None
        # points may be seen otherwise
        if lagged and (
            np.abs(weights - lagged.weights).sum() >= options.reseen * np.abs(weights).sum()
        ):
            lagged = self._linearised(lagged.jacobian, data, weights)
            self._lagged = lagged
            self._search.forget()
        if lagged and self._expired:
            lagged = self.relinearise(data, weights)
        self._expired = False
        if lagged and not whole:
            found = self._fit_lagged(lagged, data, contact, prior)
            if found is None and self._age:
                anew = self.relinearise(data, weights)
                found = self._fit_lagged(anew, data, contact, prior)
            if found is None and np.isfinite(self._value):
                value = activation.objective(both, prior, self.state)
                if value < options.stuck * self._value:
                    return 0
        if found is None:
            known = None if self._lagged is None else self._lagged.hessian
            effort = options.whole
            stop = Termination.ITERATIONS
            parts = (self.face, both, prior, self.state)
            descent = self._descent
            fitted = activation.fit(*parts, effort, matrix=known, descent=descent)
            found = LeastSquaresSolution(fitted.state, fitted.objective, fitted.iterations, stop)
            self._age = max(options.lagged_frames, options.stale_frames)
        self.state = found.point
        self._value = found.value
        self._age += 1
        # where nothing more was promised the sensitivities have nothing to do with it
        if found.termination != Termination.CONVERGED or not found.idle:
            is_unreliable = found.termination in (Termination.UNRELIABLE, Termination.STUCK)
            if self._age >= (options.lagged_frames if is_unreliable else options.stale_frames):
                self.relinearise(data, weights)
        return found.steps

    def expire(self) -> None:
        """Let the next frame be fitted by sensitivities of the state as it is now."""
        self._expired = True

    @property
    def jacobian(self) -> Jacobian | None:
        """The sensitivities that frames are fitted by, those of some frame before."""
        return None if self._lagged is None else self._lagged.jacobian

    def go_to(self, pose: Pose) -> None:
        """Go to a pose, as near its equilibrium as fitted frames are.

        Raises :class:`SolveError` if it cannot be reached; the state stays what it was.
        """
        guess = self.face.predict(self.state, pose)
        near = _correct(self.face, self.state, pose, guess, self._options.corrector)
        self.state = near or self.face.continuation(self.state, pose)

    def relinearise(self, data: Term, weights: Floats) -> LaggedModel:
        """Make the sensitivities of the state as it is, with its Hessian if that is another's."""
        pose = self.state.pose
        found = self.state.equilibrium
        far = np.abs(found.factor.x - found.x).max() > self._options.corrector.close_mm
        # what was projected, too, would be wrong in every frame that it serves
        if found.factor.projection > 0 or far:
            a = self.face.flesh_controls(pose.a)
            factorization = Factorization(self.face.flesh, self.face.linear, found.x, a)
            self.state = PosedFace(pose, replace(found, factor=factorization))
        jacobian = Sensitivity(self.face, self.state).by_pose().in_single_precision()
        self._lagged = self._linearised(jacobian, data, weights)
        self._search.forget()
        self._age = 0
        return self._lagged

    def _linearised(self, jacobian: Jacobian, data: Term, weights: Floats) -> LaggedModel:
        return LaggedModel(jacobian, data, weights, self.state.x, self._options.secants)

    def _fit_lagged(
        self, lagged: LaggedModel, data: Term, contact: Term | None, prior: Prior
    ) -> LeastSquaresSolution[PosedFace] | None:
        """Fit a frame with lagged derivatives; None if the first step leads nowhere."""
        corrector = self._options.corrector
        steps = self._options.steps
        problem = _FrameProblem(self.face, lagged, data, contact, prior, corrector, steps)
        found = minimise(problem, self.state, self._search, self._options.stop)
        return None if found.termination == Termination.STUCK and not found.steps else found


@dataclass(frozen=True)
class _FrameProblem:
    """f of a frame by lagged derivatives: a :class:`~.least_squares.LeastSquaresProblem`."""

    face: Face
    lagged: LaggedModel
    data: Term
    contact: Term | None
    regulariser: Prior
    corrector: CorrectorOptions
    steps: FeasibleStepOptions

    def value(self, point: PosedFace) -> float:
        touching = 0.0 if self.contact is None else self.contact.value(point.estimate)
        return activation.objective(self.data, self.regulariser, point) + touching

    def linearise(self, point: PosedFace) -> _FrameModel:
        gradient = self.lagged.adjoint(self.data.gradient(point.x))
        gradient += self.regulariser.gradient(point.pose)
        touching = self._touching(point)
        if touching:
            gradient += self.lagged.adjoint(touching.gradient(point.estimate))
        return _FrameModel(self, point, gradient)

    def hessian(self, point: PosedFace) -> Floats:
        """Return the Gauss-Newton matrix of the pose."""
        hessian = self.lagged.hessian.copy()
        self.regulariser.add_gauss_newton(point.pose, hessian)
        touching = self._touching(point)
        if touching:
            hessian += self.lagged.jacobian.contract(touching.curvature(point.estimate))
        return hessian

    def _touching(self, point: PosedFace) -> Term | None:
        """Return contact where there is any: found anew for every x, as f's value has found it."""
        return self.contact if self.contact and self.contact.value(point.estimate) else None

    def move(self, point: PosedFace, step: LeastSquaresStep) -> PosedFace | None:
        """Correct the equilibrium, no more, and learn from what the sensitivities have missed."""
        face = self.face
        flesh = self.face.flesh
        pose = point.pose.add(step.change)
        x = flesh.add_motion(point.x, self.lagged.flesh_motion(step.change))
        x[face.model.mandible] = face.mandible(pose.b)
        found = _correct(face, point, pose, x, self.corrector)
        if found is not None:
            missed = (found.x - x)[flesh.free].ravel()
            self.lagged.learn(pose.vector() - point.pose.vector(), missed)
        return found


@dataclass(frozen=True)
class _FrameModel:
    """f around a point by its ``gradient`` (size,): a :class:`~.least_squares.LinearModel`.

    Its matrix is made where a step is asked for.
    """

    problem: _FrameProblem
    point: PosedFace
    gradient: Floats

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """See :meth:`~.activation.DenseModel.step`."""
        pose = self.point.pose
        model = pose.layout, self.problem.hessian(self.point), self.gradient, pose.vector()
        return DenseModel(*model, options=self.problem.steps).step(damping, trust)


def _correct(
    face: Face, state: PosedFace, pose: Pose, x: Floats, options: CorrectorOptions
) -> PosedFace | None:
    """Correct a guess ``x`` (p, 3) of a pose near ``state``; None if it is far."""
    guess = untangle(face.flesh, state.x, x, options)
    if guess is None:
        return None
    a = face.flesh_controls(pose.a)
    found = correct(face.flesh, face.linear, guess, a, state.equilibrium.factor, options)
    return None if found is None else PosedFace(pose, found)
