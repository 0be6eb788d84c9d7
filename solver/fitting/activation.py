"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton: x is eliminated through the equilibrium, which is only approached on the
way, the rest being part of the linear model, as in a full-space (SQP) method. The last state is
settled. The model of f at a state is

    f(p + s) ~ f + g . s + 1/2 s . (J^T C J + R) s,    p = (a, b),    J = dx/dp

The gradient g takes one adjoint solve, a product with J^T C J two, and the matrix itself as many as
p has entries. So a matrix K from a state nearby, or from the same face fitted to other data, stands
in for it: it gives a direction within the bounds, an exact product says how far to go in it, and a
BFGS update keeps in K what the product showed. Conjugate gradients that K preconditions follow, on
the face of the bounds that hold this direction (More and Toraldo 1991), until one of them meets
another bound. The part of f's Hessian that the model leaves out, as flesh resists
more the further it goes, is learnt from the gradients (:class:`~.least_squares.SecondOrder`).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from solver.errors import SolveError
from solver.fitting.controls import Layout
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.known import FaceMuscles
from solver.fitting.least_squares import (
    DampingOptions,
    LeastSquaresStep,
    Listener,
    SecondOrder,
    StopOptions,
    Termination,
    TrustRegion,
    minimise,
)
from solver.fitting.objective import Prior, Regulariser, SkinDistance, Target, Term
from solver.fitting.recruitment import Recruitment
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.steps import FeasibleStepOptions
from solver.scans.known_activations import NOTHING, KnownMuscles
from solver.surface import Floats


@dataclass(frozen=True)
class ActivationOptions:
    """End of a fit: after ``max_iterations``, or when a step gains less than ``tolerance`` f."""

    max_iterations: int = 20
    tolerance: float = 1e-4


# weights and end for an expression that S was not fitted to: w_a low from the start
UNSEEN = {"w_a": 1e-3, "w_v": 1e-2, "w_b": 1e-6}
UNSEEN_STOP = ActivationOptions(max_iterations=25, tolerance=1e-3)


def unseen_regulariser(
    face: Face, target: Target | None = None, known: KnownMuscles = NOTHING
) -> Regulariser:
    """Return the regulariser of an expression that S was not fitted to, around the resting face.

    Muscles that S blends are expected to do what a ``target`` calls for
    (:mod:`solver.fitting.recruitment`), and those in a table what is ``known`` (:mod:`.known`).
    """
    plain = Regulariser(UNSEEN["w_a"], UNSEEN["w_v"], UNSEEN["w_b"], face.rest_pose())
    expected = plain
    muscles = FaceMuscles.of(face)
    if target is not None and (recruitment := Recruitment.of_face(face)):
        expected = recruitment.of_target(target).without(muscles.numbers(known)).regularise(plain)
    return muscles.regularise(known, expected)


@dataclass(frozen=True)
class DescentOptions:
    """The way down, and from where it begins again."""

    damping: DampingOptions = field(
        default_factory=lambda: DampingOptions(0.1, least=1e-6, grow=8.0, shrink=8.0)
    )
    restarts: int = 3  # descents, each from the settled end of the one before
    buckled: float = 1.005  # growth of f beyond which a state that settles was not near its rest
    products: int = 16  # with J^T C J for a step, at most
    # of a direction on a face of the bounds, the first of which that ends inside
    parts: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2)
    # length of the correction that a step is left without, relative to it in the model's own norm
    accuracy: float = 0.1
    steps: FeasibleStepOptions = field(default_factory=FeasibleStepOptions)  # within bounds


@dataclass(frozen=True)
class ActivationFit:
    """A fitted state, its objective f, the iterations, and whether no step gains any more."""

    state: PosedFace
    objective: float
    iterations: int
    converged: bool


# from a state to a pose nearby by the flesh's linear response: Face.newton_predict,
# newton_continuation or predict_and_solve
Continuation = Callable[[Face, PosedFace, Floats, Pose], PosedFace]


def objective(data: Term, regulariser: Prior, state: PosedFace) -> float:
    """Return f at a state's estimate (see :mod:`solver.fitting.objective`)."""
    return data.value(state.estimate) + regulariser.value(state.pose)


def fit(
    face: Face,
    data: Term,
    regulariser: Prior,
    start: PosedFace | None = None,
    options: ActivationOptions = ActivationOptions(),
    listen: Listener | None = None,
    *,
    matrix: Floats | None = None,
    descent: DescentOptions = DescentOptions(),
) -> ActivationFit:
    """Minimise f over (a, b) from ``start``, else from the neutral face, and settle the result.

    ``matrix`` (size, size) is f's Gauss-Newton matrix without its priors, or that of a state
    nearby or of other data. Without it that of ``start`` is made, as dear as a few iterations.
    Controls with bounds take steps within them; a ``start`` with muscles outside is brought in
    first (:func:`enter`).

    Where the descent gets stuck, or the flesh buckles as it settles or does not settle, the fit
    goes on from the best that did settle, else from the neutral face, every state on the way then
    being settled too. A descent that gets stuck where it began has found the minimum. Raises
    :class:`SolveError` (``solve.no_convergence``) if the face cannot be settled even so.
    """
    if start is None and matrix is None:
        matrix = rest_curvature(face)
    best = None
    begin = face.rest if start is None else enter(face, data, regulariser, start, descent)
    iterations = 0
    go = Face.newton_continuation
    for _ in range(descent.restarts):
        try:
            found = descend(face, data, regulariser, begin, options, listen, go, matrix, descent)
        except SolveError:
            if best is None:
                raise
            break
        iterations += found.iterations
        stuck = not found.converged and found.iterations < options.max_iterations
        near = found.state
        state = face.settle(near.pose, near.x, near.equilibrium.factor)
        if state is not None:
            value = objective(data, regulariser, state)
            gained = best is None or value < (1.0 - options.tolerance) * best.objective
            if best is None or value < best.objective:
                best = ActivationFit(state, value, iterations, found.converged)
            if stuck and not gained:
                best = replace(best, converged=True)
                break
            if value <= descent.buckled * found.objective and not stuck:
                # one that was stuck before may have had no further to go
                best = replace(best, converged=best.converged or found.converged)
                break
        matrix = None
        go = Face.predict_and_solve if state is None else Face.newton_continuation
        begin = best.state if best else face.rest
    if best is None:
        raise SolveError("solve.no_convergence", "the fitted face does not come to rest")
    return best


def descend(
    face: Face,
    data: Term,
    regulariser: Prior,
    start: PosedFace,
    options: ActivationOptions,
    listen: Listener | None = None,
    go: Continuation = Face.newton_continuation,
    matrix: Floats | None = None,
    descent: DescentOptions = DescentOptions(),
) -> ActivationFit:
    """Minimise f over (a, b), going from state to state by ``go``, which settles them or not."""
    if matrix is None:
        matrix = curvature(face, data, start)
    problem = _PoseProblem(face, data, regulariser, go, matrix, descent)
    stop = StopOptions(options.max_iterations, options.tolerance, options.tolerance)
    found = minimise(problem, start, TrustRegion(descent.damping), stop, listen)
    converged = found.termination == Termination.CONVERGED
    return ActivationFit(found.point, found.value, found.steps + found.idle, converged)


@dataclass
class _PoseProblem:
    """f over (a, b) of one expression: a :class:`~.least_squares.LeastSquaresProblem`."""

    face: Face
    data: Term
    regulariser: Prior
    go: Continuation
    matrix: Floats
    options: DescentOptions
    model: GaussNewton | None = None
    second: SecondOrder | None = None
    taken: LeastSquaresStep | None = None  # the last step, which led to where f is linearised next

    def value(self, point: PosedFace) -> float:
        return objective(self.data, self.regulariser, point)

    def linearise(self, point: PosedFace) -> GaussNewton:
        before = self.model
        # the model begins with the matrix of the one before
        learnt = LearntMatrix.of(self.matrix) if before is None else before.learnt
        model = GaussNewton(self.face, self.data, self.regulariser, point, learnt, self.options)
        if self.second is None:
            self.second = SecondOrder(np.zeros((len(model.gradient), len(model.gradient))))
        if before is not None and self.taken is not None:
            self.second = self.second.after(self.taken, model.gradient - before.gradient)
        self.model = model.plus(self.second.matrix)
        return self.model

    def move(self, point: PosedFace, step: LeastSquaresStep) -> PosedFace | None:
        self.taken = step
        try:
            return self.go(self.face, point, step.response, point.pose.add(step.change))
        except SolveError:
            return None


@dataclass(frozen=True)
class LearntMatrix:
    """K (k, k) = L L^T, which learns by BFGS and stays positive semi-definite by its ``root`` L.

    Updated by itself it does not where few points have weight: K is then singular, and what
    rounding makes of s . K s in its kernel makes it indefinite by more with every update.
    """

    matrix: Floats
    root: Floats

    @classmethod
    def of(cls, matrix: Floats) -> LearntMatrix:
        """Begin with a positive semi-definite matrix, as far as rounding left it one."""
        values, vectors = np.linalg.eigh(matrix)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return cls(root @ root.T, root)

    def update(self, change: Floats, seen: Floats) -> LearntMatrix:
        """Return the matrix whose product with ``change`` is what was ``seen``."""
        along = self.root.T @ change
        guessed = float(along @ along)
        true = float(change @ seen)
        # what the data do not feel is left to the regulariser
        if min(guessed, true) <= 1e-12 * np.abs(self.matrix).max() * float(change @ change):
            return self
        expected = self.root @ along
        towards = seen / np.sqrt(true * guessed) - expected / guessed
        known = np.stack([expected / -guessed, seen / true], axis=1)
        matrix = known @ np.stack([expected, seen])
        matrix += self.matrix
        root = np.outer(towards, along)
        root += self.root
        return LearntMatrix(matrix, root)


class GaussNewton:
    """f's model at ``state``; ``learnt`` is K, corrected as steps are taken."""

    def __init__(
        self,
        face: Face,
        data: Term,
        regulariser: Prior,
        state: PosedFace,
        learnt: LearntMatrix,
        options: DescentOptions = DescentOptions(),
    ) -> None:
        self._options = options
        self._layout = state.pose.layout
        self._q = state.pose.vector()
        sensitivity = Sensitivity(face, state)
        by_x = data.gradient(state.estimate)
        self._sensitivity = sensitivity
        self._curvature = data.curvature(state.estimate)
        self._known = regulariser.gauss_newton(state.pose)
        self.gradient = sensitivity.response.adjoint(sensitivity.pose, by_x)
        self.gradient += regulariser.gradient(state.pose)
        self.learnt = learnt

    def plus(self, matrix: Floats) -> GaussNewton:
        """Return the model with a further part (k, k) of f's Hessian."""
        other = copy.copy(self)
        other._known = self._known + matrix
        return other

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """See :meth:`DenseModel.step`."""
        units = damping * self._layout.damping
        step, curved = self._minimise(self._known + np.diag(units))
        fraction = self._layout.part_within(trust, step)
        part = fraction * step
        curved = fraction * (curved - units * step)
        step = self._layout.bounds.keep(self._q, part)
        curved += (self.learnt.matrix + self._known) @ (step - part)
        slope = float(self.gradient @ step)
        quadratic = float(step @ curved)
        response = self._sensitivity.response.free_motion(self._sensitivity.pose, step)
        reach = self._layout.reach(step)
        return LeastSquaresStep(step, slope, quadratic, reach, response, curved)

    def _minimise(self, known: Floats) -> tuple[Floats, Floats]:
        """Return about the best step s (size,) within the bounds, and (J^T C J + R) s.

        ``known`` R (size, size) is the part of the Hessian that takes no products.
        """
        step = np.zeros_like(self.gradient)
        curved = np.zeros_like(self.gradient)
        left = self._options.products
        while left:
            gradient = self.gradient + curved
            at = self.learnt.matrix + known, gradient, self._q + step
            model = self._layout.steps(*at, options=self._options.steps)
            direction = model.best(gradient)
            # the end of the first is where the bounds are met
            longest = np.inf if self._layout.bounds.is_free else 1.0
            part = 1.0
            while left and part == 1.0:
                square = -float(direction @ gradient)
                if square <= self._options.accuracy**2 * step @ curved:
                    return step, curved
                left -= 1
                seen = self._sensitivity.product(self._curvature, direction)
                self.learnt = self.learnt.update(direction, seen)
                image = seen + known @ direction
                curvature = float(direction @ image)
                length = min(square / curvature, longest)
                part = self._part_inside(step, length * direction)
                step = step + part * length * direction
                curved = curved + part * length * image
                gradient = self.gradient + curved
                ahead = -model.following()(gradient)
                if longest == np.inf:
                    ahead -= float(ahead @ image) / curvature * direction
                direction = ahead
                longest = np.inf
        return step, curved

    def _part_inside(self, step: Floats, further: Floats) -> float:
        """Return how much of a change (size,) beyond a ``step`` keeps within the muscles' set."""
        parts = self._options.parts
        at = self._q + step
        inside = (part for part in parts if self._layout.bounds.contains(at + part * further))
        return next(inside, parts[-1])


def curvature(face: Face, data: Term, state: PosedFace) -> Floats:
    """Return J^T C J at a state, (size, size): f's Gauss-Newton matrix but for its priors."""
    jacobian = Sensitivity(face, state).by_pose()
    return jacobian.contract(data.curvature(state.estimate))


_AT_REST: WeakKeyDictionary[Face, Floats] = WeakKeyDictionary()


def rest_curvature(face: Face) -> Floats:
    """Return :func:`curvature` of the neutral face for points all alike, made once for a face."""
    if face not in _AT_REST:
        target = Target.from_points(face.face_points(face.rest.x))
        _AT_REST[face] = curvature(face, SkinDistance(face, target), face.rest)
    return _AT_REST[face]


def _whole_model(
    face: Face, data: Term, regulariser: Prior, state: PosedFace, options: FeasibleStepOptions
) -> DenseModel:
    """Return f's model at a state with its matrix as it is there."""
    jacobian = Sensitivity(face, state).by_pose()
    gradient = jacobian.adjoint(data.gradient(state.estimate)) + regulariser.gradient(state.pose)
    hessian = jacobian.contract(data.curvature(state.estimate))
    hessian += regulariser.gauss_newton(state.pose)
    at = state.pose.layout, hessian, gradient, state.pose.vector()
    return DenseModel(*at, jacobian.flesh, options)


def enter(
    face: Face,
    data: Term,
    regulariser: Prior,
    state: PosedFace,
    options: DescentOptions = DescentOptions(),
) -> PosedFace:
    """Bring a state within the bounds of ``face``, other muscles making up for what is cut.

    It goes where f's model at ``state`` is least, however near the bounds are: clipped states make
    the next step on S a poor one. The neutral face where that cannot be reached.
    """
    state = replace(state, pose=replace(state.pose, form=face.layout))
    if face.layout.bounds.contains(state.pose.vector()):
        return state
    with suppress(SolveError):
        model = _whole_model(face, data, regulariser, state, options.steps)
        step = model.step(options.damping.start, np.inf)
        pose = state.pose.add(step.change)
        with suppress(SolveError):
            return face.newton_continuation(state, step.response, pose)
        return face.continuation(face.rest, pose)
    return face.rest


@dataclass(frozen=True)
class DenseModel:
    """f's model by its ``gradient`` and a whole ``hessian``, in ``layout``.

    ``q`` (size,) is where it is; ``motion`` (free coordinates, size) is what else is linear in the
    step; ``options`` are of steps within bounds.
    """

    layout: Layout
    hessian: Floats
    gradient: Floats
    q: Floats
    motion: NDArray[np.floating] | None = None
    options: FeasibleStepOptions = field(default_factory=FeasibleStepOptions)

    def plus(self, matrix: Floats) -> DenseModel:
        """Return the model with a further part (k, k) of f's Hessian."""
        return replace(self, hessian=self.hessian + matrix)

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """Return the step with ``damping`` D^2 added to the matrix, cut to the reach ``trust``.

        Raises :class:`SolveError` (``solve.not_finite``) where there is none.
        """
        damped = self.hessian.copy()
        damped[np.diag_indices_from(damped)] += damping * self.layout.damping
        within = self.layout.steps(damped, self.gradient, self.q, options=self.options)
        step = within.best(self.gradient)
        step = self.layout.part_within(trust, step) * step
        step = self.layout.bounds.keep(self.q, step)
        image = self.hessian @ step
        slope = float(self.gradient @ step)
        quadratic = float(step @ image)
        response = np.zeros(0) if self.motion is None else self.motion @ step
        model = step, slope, quadratic, self.layout.reach(step), response, image
        return LeastSquaresStep(*model, following=within.following)
