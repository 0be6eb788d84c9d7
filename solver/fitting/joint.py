"""One Gauss-Newton step on everything the multi-target problem solves for: S, and every a_k, b_k.

S stands here for anything that shapes a face in all of its poses (:class:`Shape`).

    f = sum_k [ data_k(x_k) + regulariser(a_k, b_k) ] + w_s/2 |S - S_0|^2 + 1/2 |L (S - S_0)|^2

The equilibria x_k are eliminated as everywhere (:mod:`solver.fitting.sensitivity`). Linearised,
expression k adds g_k . dx_k + 1/2 dx_k . C_k dx_k with dx_k = X_k dS + Z_k dp_k, p_k = (a_k, b_k).
The matrix of its pose, B_k = Z_k^T C_k Z_k + R_k, is small and dense. Eliminating dp_k as well
(variable projection: Golub and Pereyra 1973) leaves a problem in S alone with the Hessian

    sum_k X_k^T (C_k - T_k B_k^-1 T_k^T) X_k + w_s + L^T L,    T_k = C_k Z_k,

which is never formed: it is minimised on the simplex by products, two solves an expression each.
The published block coordinate descent solves for S and the poses in turn, which leaves T_k out and
goes a shorter way with every round.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.least_squares import DampingOptions
from solver.fitting.objective import Regulariser, Term, sparse
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.simplex import minimise_on_simplex, replace_values
from solver.mechanics.equilibrium import PredictorOptions
from solver.mechanics.linear import in_threads
from solver.mechanics.response import FleshControls
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class JointOptions:
    """Steps on S and all poses: trust in the linear model, and the damping of S and of a pose."""

    largest_change: float = 0.3  # of an entry of S in a step
    halvings: int = 3
    # parts of its own step that an expression is left with which loses by the whole of it, as where
    # lips meet: the others and S do not wait for it
    pose_parts: tuple[float, ...] = (0.5, 0.25, 0.0)
    damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-5, least=1e-7))
    pose_damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-2, least=1e-6))


class Shape(Protocol):
    """A face as a function of values (k,): rows of them are on the simplex, the last ones free."""

    @property
    def indptr(self) -> Ints:
        """Return the rows' places; values beyond the last are in none."""

    def face(self, values: Floats) -> Face:
        """Return the face."""

    def rates(self, sensitivity: Sensitivity, values: Floats) -> FleshControls:
        """Return the forces' derivative by the values, at a state of their face."""


@dataclass(frozen=True)
class WeightShape(Shape):
    """The values (nnz,) of S."""

    plain: Face

    @override
    @property
    def indptr(self) -> Ints:
        return np.asarray(self.plain.S.indptr)

    @override
    def face(self, values: Floats) -> Face:
        return self.plain.with_unchecked_weights(replace_values(self.plain.S, values))

    @override
    def rates(self, sensitivity: Sensitivity, values: Floats) -> FleshControls:
        return sensitivity.weights


@dataclass(frozen=True)
class GeometryProblem:
    """f: the terms and the regulariser of every expression, and the priors of S."""

    face: Face
    data: Mapping[str, Term]
    regularisers: Mapping[str, Regulariser]
    w_s: float
    prior: Floats  # (nnz,) the values of S_0
    structure: sp.csr_array  # L (k, nnz)
    other: Shape | None = None  # in the place of S

    @property
    def shape(self) -> Shape:
        """Return what the values are of."""
        return self.other or WeightShape(self.face)

    def value(self, values: Floats, states: Mapping[str, PosedFace]) -> float:
        """Return f at the states' estimates."""
        data = sum(self.expression_value(name, state) for name, state in states.items())
        return data + self.prior_value(values)

    def expression_value(self, name: str, state: PosedFace) -> float:
        """Return one expression's contribution to f."""
        return activation.objective(self.data[name], self.regularisers[name], state)

    def prior_value(self, values: Floats) -> float:
        """Return the priors of S."""
        away = values - self.prior
        unlike = self.structure @ away
        return float(0.5 * self.w_s * away @ away + 0.5 * unlike @ unlike)

    def prior_gradient(self, values: Floats) -> Floats:
        """Return the derivative of :meth:`prior_value`, (nnz,)."""
        away = values - self.prior
        return np.asarray(self.w_s * away + self.structure.T @ (self.structure @ away))


@dataclass(frozen=True)
class Iterate:
    """Values of S and the states of a fit, with the damping of S's and every pose's models."""

    values: Floats
    states: dict[str, PosedFace]
    damping: float = JointOptions().damping.start
    pose_damping: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RoundOptions:
    """Ends of rounds."""

    retries: int = 3  # of a round whose step was refused, each shorter
    tolerance: float = 3e-3  # gain, relative to f, below which two rounds in turn are the last


# called as a round begins, with the states so far
Listener = Callable[[int, Mapping[str, PosedFace]], None]


@dataclass(frozen=True)
class RoundEnd:
    """What a round came to."""

    number: int  # from 0
    objective: float  # f, mm^2
    states: Mapping[str, PosedFace]
    seconds: float


# called as a round ends
EndListener = Callable[[RoundEnd], None]


def minimise_rounds(
    problem_of: Callable[[int], GeometryProblem],
    now: Iterate,
    rounds: range,
    options: RoundOptions,
    listen: Listener | None = None,
    enter: Callable[[int, Iterate], Iterate] | None = None,
    ended: EndListener | None = None,
) -> tuple[Iterate, int]:
    """Return the iterate after ``rounds`` on the problem of each, and how many it took.

    ``enter`` prepares the iterate for a round, as where its bounds are new.
    """
    idle = taken = 0
    for number in rounds:
        begin = time.perf_counter()
        if enter:
            now = enter(number, now)
        if listen:
            listen(number, now.states)
        problem = problem_of(number)
        before = problem.value(now.values, now.states)
        now = _round(problem, now, options.retries)
        taken = taken + 1
        after = problem.value(now.values, now.states)
        if ended:
            ended(RoundEnd(number, after, now.states, time.perf_counter() - begin))
        gain = before - after
        idle = idle + 1 if gain < options.tolerance * before else 0
        if idle == 2:
            break
    return now, taken


def _round(problem: GeometryProblem, now: Iterate, retries: int) -> Iterate:
    """Return the next iterate; a refused step is no sign of convergence, and is tried again."""
    for _ in range(1 + retries):
        before = now
        now = step(problem, now)
        if now.values is not before.values:
            break
    return now


def step(problem: GeometryProblem, now: Iterate, options: JointOptions = JointOptions()) -> Iterate:
    """Return a better iterate, or the same with the losing states settled, and more damping."""
    rule = options.damping
    pose_rule = options.pose_damping
    shape = problem.shape
    face = problem.shape.face(now.values)
    damping = {name: now.pose_damping.get(name, pose_rule.start) for name in now.states}

    def linearise(name: str) -> _Linearised:
        return _Linearised(problem, face, now.values, name, now.states[name], damping[name])

    models = in_threads(linearise, now.states)
    change = _change(problem, now, models, options.largest_change)
    before = problem.prior_value(now.values)
    for halving in range(options.halvings):
        fraction = 0.5**halving
        part = fraction * change
        values = now.values + part
        follow = partial(
            _Linearised.follow,
            face=shape.face(values),
            change=part,
            fraction=fraction,
            pose_parts=options.pose_parts,
        )
        tried = dict(zip(now.states, in_threads(follow, models), strict=True))
        for name, (whole, *_) in tried.items():
            damping[name] = pose_rule.adapt(damping[name], whole.ratio)
        trials = {name: max(each, key=lambda trial: trial.gain) for name, each in tried.items()}
        # the priors are quadratic: what they gain is what their model says
        nearer = before - problem.prior_value(values)
        gain = sum(trial.gain for trial in trials.values()) + nearer
        if gain > 0.0:
            predicted = sum(trial.predicted for trial in trials.values()) + nearer
            # a step that had to be halved says how much too far the linear model reached
            increased = rule.increase(now.damping, halving)
            states = {name: trial.state for name, trial in trials.items() if trial.state}
            # at the minimum rounding gains where nothing is promised
            ratio = gain / predicted if predicted else 0.0
            return Iterate(values, states, rule.adapt(increased, ratio), damping)
    # near buckling the value at an estimate may flatter: settle those that lose, where possible
    states = dict(now.states)
    for name, state in now.states.items():
        if trials[name].gain < 0.0:
            states[name] = face.settle(state.pose, state.x) or state
    return Iterate(now.values, states, rule.increase(now.damping, options.halvings), damping)


def _change(
    problem: GeometryProblem, now: Iterate, models: list[_Linearised], reach: float
) -> Floats:
    """Return the change (nnz,) of S's values that minimises the damped model, poses following."""
    structure = problem.structure
    known = problem.prior_gradient(now.values)
    gradient = sum(in_threads(_Linearised.gradient_by_geometry, models), known)

    def product(direction: Floats) -> Floats:
        known = (problem.w_s + now.damping) * direction + structure.T @ (structure @ direction)
        return np.asarray(sum(in_threads(lambda model: model.product(direction), models), known))

    best = minimise_on_simplex(now.values, gradient, product, problem.shape.indptr, reach)
    return np.asarray(best - now.values)


@dataclass(frozen=True)
class _Trial:
    """Result of a step for one expression; no state, an infinite loss where it led too far."""

    state: PosedFace | None
    gain: float
    predicted: float

    @property
    def ratio(self) -> float:
        return self.gain / self.predicted if self.predicted > 0.0 else 0.0


@dataclass(frozen=True)
class _Follower:
    """The response to a change of S: the flesh, its pull on the pose, and the step of that."""

    flesh: Floats
    coupled: Floats
    by_pose: Floats


class _Linearised:
    """The Gauss-Newton model of one expression at a state, its pose's part damped."""

    def __init__(
        self,
        problem: GeometryProblem,
        face: Face,
        values: Floats,
        name: str,
        state: PosedFace,
        damping: float,
    ) -> None:
        self._problem = problem
        self._name = name
        self._state = state
        sensitivity = Sensitivity(face, state)
        jacobian = sensitivity.by_pose()
        self._response = sensitivity.response
        self._weights = problem.shape.rates(sensitivity, values)
        self._jacobian = jacobian
        data = problem.data[name]
        regulariser = problem.regularisers[name]
        gradient = data.gradient(state.estimate)
        curvature = sparse(data.curvature(state.estimate))
        self._by_x = gradient.ravel()[jacobian.free]
        self._curvature = curvature[jacobian.free][:, jacobian.free]
        image = jacobian.image(curvature)
        self._touched = image.free
        self._coupling = image.rows
        self._by_pose = jacobian.adjoint(gradient) + regulariser.gradient(state.pose)
        self._hessian = image.contracted + regulariser.gauss_newton(state.pose)
        self._layout = state.pose.layout
        self._q = state.pose.vector()
        damped = self._hessian + damping * np.diag(self._layout.damping)
        # at a bound that the step would leave, the pose does not follow
        self._steps = self._layout.steps(damped, self._by_pose, self._q, reach=1.0)
        self._follow = self._steps.following()

    def gradient_by_geometry(self) -> Floats:
        """Return f's derivative (nnz,) by S, the pose following."""
        return self._pull(self._by_x.copy(), self._by_pose)

    def product(self, change: Floats) -> Floats:
        """Return X^T (C - T B^-1 T^T) X applied to a change of S, (nnz,)."""
        flesh = self._response.free_motion(self._weights, change)
        return self._pull(self._curvature @ flesh, self._couple(flesh))

    def _pull(self, by_x: Floats, by_pose: Floats) -> Floats:
        """Return X^T (g - T B^-1 h) for g by the free coordinates, which it changes, and h."""
        by_x[self._touched] -= self._coupling @ self._follow(by_pose)
        return self._response.free_adjoint(self._weights, by_x)

    def follow(
        self, face: Face, change: Floats, fraction: float, pose_parts: Iterable[float]
    ) -> list[_Trial]:
        """Go to a ``face`` with a ``change`` (nnz,) of S, and ``fraction`` of the way to its pose.

        Other trials go shorter ways, parts of that, until one does not lose.
        """
        flesh = self._response.free_motion(self._weights, change)
        coupled = self._couple(flesh)
        follower = _Follower(flesh, coupled, self._steps.best(self._by_pose + coupled))
        trials = [self._trial(face, follower, fraction)]
        for part in pose_parts:
            if trials[-1].gain >= 0.0:
                break
            trials.append(self._trial(face, follower, part * fraction))
        return trials

    def _trial(self, face: Face, follower: _Follower, fraction: float) -> _Trial:
        problem = self._problem
        state = self._state
        flesh = follower.flesh
        coupled = follower.coupled
        by_pose = fraction * self._layout.part_within(1.0, follower.by_pose) * follower.by_pose
        if not self._layout.bounds.is_free:
            by_pose = self._layout.bounds.clip(self._q + by_pose) - self._q
        # the undamped model's gain
        first = self._by_x @ flesh + self._by_pose @ by_pose
        second = flesh @ (self._curvature @ flesh) + by_pose @ (self._hessian @ by_pose)
        predicted = float(-first - 0.5 * second - by_pose @ coupled)
        response = flesh + self._jacobian.flesh @ by_pose
        found = self._move(face, response, state.pose.add(by_pose))
        if found is None:
            return _Trial(state=None, gain=-np.inf, predicted=predicted)
        before = problem.expression_value(self._name, state)
        after = problem.expression_value(self._name, found)
        return _Trial(state=found, gain=before - after, predicted=predicted)

    def _move(self, face: Face, response: Floats, pose: Pose) -> PosedFace | None:
        """Approach a pose of a face; settle where that is too far; None where that fails too."""
        with contextlib.suppress(SolveError):
            # the next linear models, of S too, are the better for a stiffness that is that at x
            return face.newton_predict(self._state, response, pose, PredictorOptions.reach_mm)
        with contextlib.suppress(SolveError):
            return face.predict_and_solve(self._state, response, pose)
        return None

    def _couple(self, flesh: Floats) -> Floats:
        return np.asarray(self._coupling.T @ flesh[self._touched])
