"""Damped Gauss-Newton: one loop for all fits, with searches and a damping rule as its parts.

    f(q + s) ~ f + g . s + 1/2 s . (B + damping D^2) s

A problem linearises f at a state; a search takes the linear model's steps until one lowers f. The
damping (Levenberg 1944, Marquardt 1963) follows the ratio of what a step gained to what its model
promised, the reach of a step may do so as well (trust region: More and Sorensen 1983).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.linalg

from solver.errors import SolveError
from solver.mechanics.bounded import solve_bounded
from solver.surface import Floats, Ints

Point = TypeVar("Point")  # where a fit is: its variables and what follows from them

# called after each accepted step with the iteration and the objective
Listener = Callable[[int, float], None]

# r (k,) -> B^-1 r, minus the change of a step for a change r of the gradient: bounds that hold the
# step hold on
Follow = Callable[[Floats], Floats]


@dataclass(frozen=True)
class DampingOptions:
    """The damping rule; ``good`` and ``bad`` are gains, as parts of the promised."""

    start: float
    least: float
    most: float = np.inf
    grow: float = 4.0  # factor after a bad step
    shrink: float = 4.0  # divisor after a good one
    good: float = 0.75
    bad: float = 0.25

    def adapt(self, damping: float, ratio: float) -> float:
        """Return the damping after a step that gained ``ratio`` of what its model promised."""
        if ratio < self.bad:
            return self.increase(damping)
        return max(damping / self.shrink, self.least) if ratio > self.good else damping

    def increase(self, damping: float, times: int = 1) -> float:
        """Return the damping after one or several bad steps."""
        return min(damping * self.grow**times, self.most)

    def scale(self, damping: Floats, factor: Floats, fall: float) -> Floats:
        """Return dampings (k,) times ``factor`` (k,), cut to ``fall`` and the rule's growth."""
        return np.maximum(damping * np.clip(factor, fall, self.grow), self.least)


@dataclass(frozen=True)
class LeastSquaresStep:
    """A ``change`` of the variables (k,), with its linear model.

    ``slope`` is g . s and ``curvature`` s . B s, ``reach`` its length, 1 being what a linear model
    is surely good for; ``response`` is what else is linear in it, as the flesh's motion (size,);
    ``image`` is B s (k,), of models that :class:`SecondOrder` learns from. ``following`` makes how
    steps of the same matrix follow their gradients, of models that tell it.
    """

    change: Floats
    slope: float
    curvature: float
    reach: float = 0.0
    response: Floats = field(default_factory=lambda: np.zeros(0))
    image: Floats = field(default_factory=lambda: np.zeros(0))
    following: Callable[[], Follow] | None = None

    @property
    def gain(self) -> float:
        """Return what the model promises f to fall by."""
        return -self.slope - 0.5 * self.curvature

    def cut(self, part: float) -> LeastSquaresStep:
        """Return a part of the step."""
        slope = part * self.slope
        curvature = part**2 * self.curvature
        vectors = part * self.response, part * self.image
        return LeastSquaresStep(part * self.change, slope, curvature, part * self.reach, *vectors)


@dataclass(frozen=True)
class SecondOrder:
    """A (k, k), semi-definite: the part of f's Hessian that Gauss-Newton leaves out.

    A structured secant (Dennis, Gay and Welsch 1981, NL2SOL): gradients show it, step by step.
    It grows by symmetric rank one where f is stiffer along a step than its model by more than
    ``noticed`` of that, and shrinks where less is found of it.
    """

    matrix: Floats
    noticed: float = 0.25

    def after(self, step: LeastSquaresStep, turned: Floats) -> SecondOrder:
        """Learn from a step whose model had A in it; f's gradient has ``turned`` (k,) on it."""
        s = step.change
        known = self.matrix @ step.change
        missing = turned - (step.image - known)
        before = float(s @ known)
        now = float(s @ missing)
        matrix = self.matrix * (np.clip(now / before, 0.0, 1.0) if before > 0.0 else 1.0)
        residual = missing - matrix @ s
        along = float(residual @ s)
        if along > self.noticed * float(s @ step.image):
            matrix = matrix + np.outer(residual, residual) / along
        return replace(self, matrix=matrix)


class LinearModel(Protocol):
    """f around a point."""

    @property
    def gradient(self) -> Floats:
        """Return the derivative (k,) of f."""

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """Return the step that minimises the damped model, cut to a reach of ``trust``."""


def bounded_step(hessian: Floats, gradient: Floats, limits: tuple[Floats, Floats]) -> Floats:
    """Return the s that minimises g . s + s . H s / 2 within ``limits``, which it keeps exactly.

    Few of many entries meet their limits as a rule. Those that do are found on H's Schur complement
    (:mod:`solver.mechanics.bounded`), as the others follow; what these break of their own limits
    joins. Raises :class:`SolveError` (``solve.not_finite``) where H is not
    positive definite.
    """
    lower, upper = limits
    step = np.zeros_like(gradient)
    # what its bounds leave nowhere to go stays
    open_ = np.flatnonzero(upper - lower > 0.0)
    lower = lower[open_]
    upper = upper[open_]
    try:
        root = scipy.linalg.cholesky(hessian[np.ix_(open_, open_)], lower=True)
        free = -scipy.linalg.cho_solve((root, True), gradient[open_])
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error
    found = free
    meeting = np.zeros(0, np.int64)
    while True:
        outside = np.flatnonzero((found < lower) | (found > upper))
        joining = np.setdiff1d(outside, meeting)
        if len(joining) == 0:
            break
        meeting = np.concatenate([meeting, joining])
        found = _meet_limits(root, free, meeting, (lower[meeting], upper[meeting]))
    step[open_] = np.clip(found, lower, upper)
    return step


def _meet_limits(
    root: Floats, free: Floats, meeting: Ints, limits: tuple[Floats, Floats]
) -> Floats:
    """Return the best step whose ``meeting`` (k,) entries are within ``limits``, the others free.

    ``root`` is L of H = L L^T, ``free`` the best step without limits.
    """
    units = np.zeros((len(free), len(meeting)))
    units[meeting, np.arange(len(meeting))] = 1.0
    columns = scipy.linalg.solve_triangular(root, units, lower=True)
    # the Schur complement is the inverse of R^T R
    triangle = np.linalg.qr(columns, mode="r")
    scaled = scipy.linalg.solve_triangular(triangle, np.eye(len(meeting)), trans="T")
    complement = scaled.T @ scaled
    kept = np.zeros(len(meeting))
    side = np.zeros(len(meeting), np.int8)  # none is at a limit, as a guess
    if not solve_bounded(complement, complement @ free[meeting], *limits, side, kept):
        raise SolveError("solve.not_finite", "no Gauss-Newton step: it is not finite")
    pull = columns @ (complement @ (kept - free[meeting]))
    found = free + scipy.linalg.solve_triangular(root, pull, lower=True, trans="T")
    found[meeting] = kept
    return np.asarray(found)


@dataclass(frozen=True)
class BoxModel:
    """A Gauss-Newton model at q (k,) whose steps keep to bounds, and to a box around q.

    It is a :class:`LinearModel`. The box is ``trust`` times ``reach`` (k,), the changes that a
    linear model is surely good for.
    """

    q: Floats
    gradient: Floats
    hessian: Floats
    bounds: tuple[Floats, Floats]
    reach: Floats

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """See :class:`LinearModel`."""
        low, high = (bound - self.q for bound in self.bounds)
        box = trust * self.reach
        size = 1.0 / self.reach
        damped = self.hessian + damping * np.diag(size**2)
        limits = np.maximum(low, -box), np.minimum(high, box)
        change = bounded_step(damped, self.gradient, limits)
        curvature = float(change @ self.hessian @ change)
        reach = float(np.abs(change * size).max(initial=0.0))
        return LeastSquaresStep(change, float(self.gradient @ change), curvature, reach)


class LeastSquaresProblem(Protocol[Point]):
    """f, its linear models, and the way along their steps."""

    def value(self, point: Point) -> float:
        """Return f."""

    def linearise(self, point: Point) -> LinearModel:
        """Return f's model around a point."""

    def move(self, point: Point, step: LeastSquaresStep) -> Point | None:
        """Return the point a step leads to, None where that is too far."""


class Termination(StrEnum):
    """Reasons for a search to end."""

    CONVERGED = "converged"
    STUCK = "stuck"
    UNRELIABLE = "unreliable"
    ITERATIONS = "iterations"


@dataclass(frozen=True)
class StopOptions:
    """The end: after so many ``iterations``, or of gains below these parts of f."""

    iterations: int
    promised: float = 0.0  # by a step, before it is taken
    gained: float = 0.0  # by the step that was taken


@dataclass(frozen=True)
class Trial(Generic[Point]):
    """Result of a search: a better ``point`` with its f, or None with f where it began."""

    point: Point | None
    value: float
    termination: Termination | None = None  # None if the fit goes on from here


class StepSearch(Protocol):
    """Finds a step that lowers f; it may keep what it learns for the next one."""

    def descend(
        self, problem: LeastSquaresProblem[Point], point: Point, value: float, stop: StopOptions
    ) -> Trial[Point]:
        """Take the model's steps at a point where f is ``value``."""


@dataclass(frozen=True)
class LeastSquaresSolution(Generic[Point]):
    """End of a descent: f there, the steps taken to it, and why.

    ``idle`` says that one more search was begun and led nowhere.
    """

    point: Point
    value: float
    steps: int
    termination: Termination
    idle: bool = False


def minimise(
    problem: LeastSquaresProblem[Point],
    start: Point,
    search: StepSearch,
    stop: StopOptions,
    listen: Listener | None = None,
) -> LeastSquaresSolution[Point]:
    """Lower f step by step from ``start``."""
    point = start
    value = problem.value(start)
    for number in range(stop.iterations):
        found = search.descend(problem, point, value, stop)
        if found.point is None:
            termination = found.termination or Termination.STUCK
            return LeastSquaresSolution(point, value, number, termination, idle=True)
        point = found.point
        value = found.value
        if listen:
            listen(number + 1, value)
        if found.termination:
            return LeastSquaresSolution(point, value, number + 1, found.termination)
    return LeastSquaresSolution(point, value, stop.iterations, Termination.ITERATIONS)


@dataclass
class TrustRegion:
    """A search by ever shorter and more damped steps, each solved for anew."""

    rule: DampingOptions
    most: float = 1.0  # reach of a step: longer ones end, now and then, in flesh that buckles
    least: float = 2.0**-8
    tries: int = 6  # from one point before that counts as stuck
    # part of f's rise by one step that a shorter one leaves at least where f leaps, as where flesh
    # snaps: still shorter steps lead to the same place, and the point counts as stuck. Where it
    # rises by far more, as where lips cross on the way, they do not
    leap: float = 0.7

    def __post_init__(self) -> None:
        self.damping = self.rule.start
        self.reach = self.most

    def descend(
        self, problem: LeastSquaresProblem[Point], point: Point, value: float, stop: StopOptions
    ) -> Trial[Point]:
        """See :class:`StepSearch`."""
        model = problem.linearise(point)
        rise = np.inf
        for trial in range(self.tries):
            step = model.step(self.damping, self.reach)
            # a step that was cut says nothing of what is left
            whole = step.reach < 0.99 * self.reach
            if not trial and whole and step.gain <= stop.promised * value:
                return Trial(point=None, value=value, termination=Termination.CONVERGED)
            moved = problem.move(point, step)
            if moved is None:
                self._shorten(step.reach)
                continue
            reached = problem.value(moved)
            # what was refused a moment ago is not tried again at once
            self._adapt((value - reached) / step.gain, step.reach, grow=not trial)
            if reached < value:
                done = whole and value - reached <= stop.gained * reached
                return Trial(moved, reached, termination=Termination.CONVERGED if done else None)
            if self.leap * rise < reached - value < rise / self.leap:
                break
            rise = reached - value
        return Trial(point=None, value=value, termination=Termination.STUCK)

    def _adapt(self, ratio: float, taken: float, *, grow: bool) -> None:
        """Learn from a step of reach ``taken`` that gained ``ratio`` of what was promised."""
        self.damping = self.rule.adapt(self.damping, ratio)
        if ratio < self.rule.bad:
            self._shorten(taken)
        elif grow and ratio > self.rule.good and taken > 0.9 * self.reach:
            self.reach = min(2.0 * self.reach, self.most)

    def _shorten(self, taken: float) -> None:
        self.reach = max(0.5 * min(self.reach, taken), self.least)


@dataclass
class Backtracking:
    """A search along one step, cut in half and in half again; ``damping`` is of the next one.

    A step that promises too little by the matrix of the last one, what held that at a bound holding
    on, is not made: one that is made costs far more than what tells so.
    """

    rule: DampingOptions
    tries: int = 3  # of a step and its halves
    least_ratio: float = -np.inf  # of a gain to the promised one, below which the descent ends

    def __post_init__(self) -> None:
        self.damping = self.rule.start
        self._following: Callable[[], Follow] | None = None

    def forget(self) -> None:
        """Judge no step by the matrix of the last one, as another takes its place."""
        self._following = None

    def descend(
        self, problem: LeastSquaresProblem[Point], point: Point, value: float, stop: StopOptions
    ) -> Trial[Point]:
        """See :class:`StepSearch`."""
        model = problem.linearise(point)
        least = stop.promised * value
        if self._following and _promise(self._following(), model.gradient) <= least:
            return Trial(point=None, value=value, termination=Termination.CONVERGED)
        step = model.step(self.damping, 1.0)
        self._following = step.following
        if step.gain <= least:
            return Trial(point=None, value=value, termination=Termination.CONVERGED)
        for _ in range(self.tries):
            moved = problem.move(point, step)
            reached = np.inf if moved is None else problem.value(moved)
            if reached < value:
                ratio = (value - reached) / step.gain
                self.damping = self.rule.adapt(self.damping, ratio)
                if ratio < self.least_ratio:
                    return Trial(moved, reached, termination=Termination.UNRELIABLE)
                done = value - reached <= stop.gained * reached
                return Trial(moved, reached, termination=Termination.CONVERGED if done else None)
            step = step.cut(0.5)
            self.damping = self.rule.increase(self.damping)
        return Trial(point=None, value=value, termination=Termination.STUCK)


def _promise(follow: Follow, gradient: Floats) -> float:
    """Return what the best step of a ``gradient`` (k,) gains."""
    return float(0.5 * gradient @ follow(gradient))
