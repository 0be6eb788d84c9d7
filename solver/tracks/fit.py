"""Weights of shapes and a jaw, fitted to a scan through the flesh under its muscle tracks.

    min over q = (w, j)    data(x(q)) + w_w/2 |w|^2 + w_j/2 |j|^2 + w_t/2 |q - q_0|^2

with 0 <= w <= 1, q_0 being the frame before in a sequence; else w_t is 0.

x(q) is the flesh at rest between its tracks, bones and whatever touches, and dx/dq is exact
(:mod:`solver.tracks.response`); or x(q) is that of plain shapes (:mod:`solver.tracks.plain`), which
the same terms fit. Gauss-Newton with a trust region: each step is the least of its
model within the bounds and a box around q. Published weights have no bounds; here they stay in
[0, 1], where an animator can take them up, unless they are asked to be free.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np
from typing_extensions import override

from solver.errors import SolveError
from solver.fitting.face import Face
from solver.fitting.least_squares import (
    BoxModel,
    DampingOptions,
    LeastSquaresProblem,
    LeastSquaresSolution,
    LeastSquaresStep,
    LinearModel,
    Listener,
    StopOptions,
    TrustRegion,
    minimise,
)
from solver.fitting.objective import Term
from solver.mechanics.boundary import JAW_FREEDOM
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackPose


class ShapeState(Protocol):
    """A face under controls q: the flesh's vertices x (p, 3), and what it was asked for."""

    @property
    def q(self) -> Floats:
        """Return the controls (K + 5,)."""

    @property
    def x(self) -> Floats:
        """Return the vertices (p, 3)."""

    @property
    def pose(self) -> TrackPose:
        """Return what the controls ask for."""

    @property
    def inverted(self) -> int:
        """Return how many tets are inside out."""


State = TypeVar("State", bound=ShapeState)


class ShapeFace(Protocol[State]):
    """A face that weights of shapes and a jaw drive.

    :class:`~solver.tracks.face.TrackFace` or :class:`~solver.tracks.plain.PlainFace`.
    """

    face: Face
    tracks: MuscleTracks

    def rest(self) -> State:
        """Return the neutral face."""

    def move(self, state: State, q: Floats) -> State:
        """Go from a state to controls q (K + 5,)."""

    def skin(self, state: State) -> Floats:
        """Return the whole skin (V, 3)."""

    def columns(self, state: State) -> Floats:
        """Return dx/dq (p, 3, K + 5)."""

    def skin_columns(self, state: State) -> Floats:
        """Return the derivatives (V, 3, K + 5) of the whole skin."""


@dataclass(frozen=True)
class TrackFitOptions:
    """Prices and bounds of controls, and the end of a fit."""

    w_w: float = 1e-4  # mm^2, of the weights
    w_j: float = 1e-4  # of the jaw on top of theirs, by rad^2 and mm^2
    # of every weight; infinite ones leave them free, as published
    bounds: tuple[float, float] = (0.0, 1.0)
    w_t: float = 0.0  # price of all controls' change from the frame before
    # changes that a linear model is surely good for: of a weight, of the jaw in rad and in mm
    weight_reach: float = 0.5
    turn_reach: float = 0.1
    shift_reach_mm: float = 3.0
    stop: StopOptions = field(default_factory=lambda: StopOptions(20, 1e-4, 1e-4))
    damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-6, least=1e-9))

    def price_of(self, tracks: MuscleTracks) -> Floats:
        """Return the prices (K + 5,) of the controls."""
        jaw = np.full(JAW_FREEDOM, self.w_j)
        return np.concatenate([np.full(len(tracks.names), self.w_w), jaw])

    def reach_of(self, tracks: MuscleTracks) -> Floats:
        """Return the changes (K + 5,) of the controls that a linear model is good for."""
        weights = np.full(len(tracks.names), self.weight_reach)
        turns = 2 * [self.turn_reach]
        shifts = 3 * [self.shift_reach_mm]
        return np.concatenate([weights, turns, shifts])

    def bounds_of(self, tracks: MuscleTracks) -> tuple[Floats, Floats]:
        """Return the bounds (K + 5,) of the controls; the jaw has none."""
        free = np.full(JAW_FREEDOM, np.inf)
        low, high = (np.full(len(tracks.names), bound) for bound in self.bounds)
        return np.concatenate([low, -free]), np.concatenate([high, free])


def fit(
    face: ShapeFace[State],
    data: Term,
    start: State | None = None,
    options: TrackFitOptions = TrackFitOptions(),
    listen: Listener | None = None,
    before: Floats | None = None,
) -> LeastSquaresSolution[State]:
    """Fit weights and jaw to what ``data`` asks of the flesh, from rest or from a ``start``; mm^2.

    ``before`` (K + 5,) are the controls that changes count from, if not the start's.

    ``data`` is a term of ``face.face``, such as
    :class:`~solver.fitting.objective.SkinDistance`. Raises :class:`~solver.errors.SolveError` as
    :class:`~solver.tracks.response.TrackResponse`, where the start is no equilibrium.
    """
    begun = face.rest() if start is None else start
    problem = _ShapeProblem(face, data, options, begun.q if before is None else before)
    return minimise(problem, begun, TrustRegion(options.damping), options.stop, listen)


@dataclass(frozen=True)
class _ShapeProblem(LeastSquaresProblem[State]):
    face: ShapeFace[State]
    data: Term
    options: TrackFitOptions
    before: Floats  # (K + 5,) the controls that changes count from

    @cached_property
    def prices(self) -> Floats:
        """The prices (K + 5,) of the controls."""
        return self.options.price_of(self.face.tracks)

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """The bounds (K + 5,) of the controls."""
        return self.options.bounds_of(self.face.tracks)

    @override
    def value(self, point: State) -> float:
        change = self.options.w_t * float(np.sum((point.q - self.before) ** 2))
        return self.data.value(point.x) + 0.5 * (float(self.prices @ point.q**2) + change)

    @override
    def linearise(self, point: State) -> LinearModel:
        columns = self.face.columns(point).reshape(-1, len(point.q))
        w_t = self.options.w_t
        prior = self.prices * point.q + w_t * (point.q - self.before)
        gradient = columns.T @ self.data.gradient(point.x).ravel() + prior
        curvature = self.data.curvature(point.x)
        hessian = columns.T @ np.asarray(curvature @ columns) + np.diag(self.prices + w_t)
        reach = self.options.reach_of(self.face.tracks)
        return BoxModel(point.q, gradient, hessian, self.bounds, reach)

    @override
    def move(self, point: State, step: LeastSquaresStep) -> State | None:
        try:
            return self.face.move(point, np.clip(point.q + step.change, *self.bounds))
        except SolveError:
            return None
