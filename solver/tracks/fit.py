"""Weights of shapes and a jaw, fitted to a scan through the flesh under its muscle tracks.

    min over q = (w, j)    data(x(q)) + w_w/2 |w|^2 + w_j/2 |j|^2    with 0 <= w <= 1

x(q) is the flesh at rest between its tracks, bones and whatever touches, and dx/dq is exact
(:mod:`solver.tracks.response`). Gauss-Newton with a trust region: each step is the least of its
model within the bounds and a box around q. Published weights have no bounds; here they stay in
[0, 1], where an animator can take them up, unless they are asked to be free.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from typing_extensions import override

from solver.errors import SolveError
from solver.fitting.least_squares import (
    DampingOptions,
    LeastSquaresProblem,
    LeastSquaresStep,
    LinearModel,
    Listener,
    StopOptions,
    Termination,
    TrustRegion,
    bounded_step,
    minimise,
)
from solver.fitting.objective import Term
from solver.mechanics.boundary import JAW_FREEDOM
from solver.surface import Floats
from solver.tracks.face import TrackFace, TrackState
from solver.tracks.response import TrackResponse


@dataclass(frozen=True)
class TrackFitOptions:
    """Prices and bounds of controls, and the end of a fit."""

    w_w: float = 1e-4  # mm^2, of the weights
    w_j: float = 1e-4  # of the jaw on top of theirs, by rad^2 and mm^2
    # of every weight; infinite ones leave them free, as published
    bounds: tuple[float, float] = (0.0, 1.0)
    # changes that a linear model is surely good for: of a weight, of the jaw in rad and in mm
    weight_reach: float = 0.5
    turn_reach: float = 0.1
    shift_reach_mm: float = 3.0
    stop: StopOptions = field(default_factory=lambda: StopOptions(20, 1e-4, 1e-4))
    damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-6, least=1e-9))


@dataclass(frozen=True)
class TrackFit:
    """End of a fit: the flesh there, the objective in mm^2, the steps to it, and why."""

    state: TrackState
    objective: float
    steps: int
    termination: Termination


def fit(
    face: TrackFace,
    data: Term,
    start: TrackState | None = None,
    options: TrackFitOptions = TrackFitOptions(),
    listen: Listener | None = None,
) -> TrackFit:
    """Fit weights and jaw to what ``data`` asks of the flesh, from rest or from a ``start``.

    ``data`` is a term of ``face.face``, such as
    :class:`~solver.fitting.objective.SkinDistance`. Raises :class:`~solver.errors.SolveError` as
    :class:`~solver.tracks.response.TrackResponse`, where the start is no equilibrium.
    """
    problem = _Problem(face, data, options)
    begun = face.rest() if start is None else start
    found = minimise(problem, begun, TrustRegion(options.damping), options.stop, listen)
    return TrackFit(found.point, found.value, found.steps, found.termination)


@dataclass(frozen=True)
class _Problem(LeastSquaresProblem[TrackState]):
    face: TrackFace
    data: Term
    options: TrackFitOptions

    @cached_property
    def prices(self) -> Floats:
        """The prices (K + 5,) of the controls."""
        weights = np.full(len(self.face.tracks.names), self.options.w_w)
        return np.concatenate([weights, np.full(JAW_FREEDOM, self.options.w_j)])

    @cached_property
    def reach(self) -> Floats:
        """The changes (K + 5,) of the controls that a linear model is good for."""
        options = self.options
        weights = np.full(len(self.face.tracks.names), options.weight_reach)
        turns, shifts = 2 * [options.turn_reach], 3 * [options.shift_reach_mm]
        return np.concatenate([weights, turns, shifts])

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """The bounds (K + 5,) of the controls."""
        count = len(self.face.tracks.names)
        free = np.full(JAW_FREEDOM, np.inf)
        low, high = (np.full(count, bound) for bound in self.options.bounds)
        return np.concatenate([low, -free]), np.concatenate([high, free])

    @override
    def value(self, point: TrackState) -> float:
        return self.data.value(point.x) + 0.5 * float(self.prices @ point.q**2)

    @override
    def linearise(self, point: TrackState) -> LinearModel:
        columns = TrackResponse(self.face, point).columns().reshape(-1, len(point.q))
        gradient = columns.T @ self.data.gradient(point.x).ravel() + self.prices * point.q
        curvature = self.data.curvature(point.x)
        hessian = columns.T @ np.asarray(curvature @ columns) + np.diag(self.prices)
        return _Model(self, point.q, gradient, hessian)

    @override
    def move(self, point: TrackState, step: LeastSquaresStep) -> TrackState | None:
        try:
            return self.face.move(point, np.clip(point.q + step.change, *self.bounds))
        except SolveError:
            return None


@dataclass(frozen=True)
class _Model(LinearModel):
    """The Gauss-Newton model of a problem at q."""

    problem: _Problem
    q: Floats
    gradient: Floats
    hessian: Floats

    @override
    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        low, high = (bound - self.q for bound in self.problem.bounds)
        box, size = trust * self.problem.reach, 1.0 / self.problem.reach
        damped = self.hessian + damping * np.diag(size**2)
        limits = np.maximum(low, -box), np.minimum(high, box)
        change = bounded_step(damped, self.gradient, limits)
        curvature = float(change @ self.hessian @ change)
        reach = float(np.abs(change * size).max(initial=0.0))
        return LeastSquaresStep(change, float(self.gradient @ change), curvature, reach)
