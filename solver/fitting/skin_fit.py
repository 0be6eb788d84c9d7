"""Fits of any controls to a target skin, by Gauss-Newton within their bounds.

    f(q) = 1/k sum_v |(M x(q))_v - t_v|^2 + w |q - q_rest|^2,    lower <= q <= upper

The equilibrium x(q) is differentiated by :class:`~solver.mechanics.response.Response`; the step
solves the bounded linear least squares, so that bounds hold exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from solver.errors import SolveError
from solver.fitting.controls import FitControls
from solver.fitting.face import Face
from solver.fitting.least_squares import (
    Backtracking,
    DampingOptions,
    LeastSquaresSolution,
    LeastSquaresStep,
    StopOptions,
    minimise,
)
from solver.mechanics.equilibrium import Equilibrium, solve_equilibrium
from solver.mechanics.response import Response
from solver.surface import Floats


@dataclass(frozen=True)
class SkinFitOptions:
    """Weight of the rest, and when to stop."""

    w_rest: float = 1e-2  # mm^2 by the square of q's units
    room: float = 1e-9  # beyond a bound that is reached
    stop: StopOptions = field(default_factory=lambda: StopOptions(12, gained=1e-3))
    tries: int = 5  # of a step and its halves


@dataclass(frozen=True)
class SkinPoint:
    """Controls q (k,) and the equilibrium they lead to."""

    q: Floats
    equilibrium: Equilibrium


class SkinFit:
    """f of ``controls`` for the face's points (k, 3) at ``target``: a ``LeastSquaresProblem``."""

    def __init__(
        self,
        face: Face,
        controls: FitControls,
        target: Floats,
        options: SkinFitOptions = SkinFitOptions(),
    ) -> None:
        self._face, self._controls, self._target, self._options = face, controls, target, options

    def solve(self) -> LeastSquaresSolution[SkinPoint]:
        """Minimise f from rest."""
        start = self.settle(self._controls.layout.rest, self._face.model.rest)
        search = Backtracking(DampingOptions(0.0, least=0.0), self._options.tries)
        return minimise(self, start, search, self._options.stop)

    def settle(self, q: Floats, x: Floats) -> SkinPoint:
        """Return the equilibrium of q, found from x (p, 3)."""
        face, flesh, x = self._face, self._controls.flesh, x.copy()
        x[flesh.held] = self._controls.held_positions(q)
        drive, tolerance = self._controls.flesh_controls(q), face.tolerance
        found = solve_equilibrium(flesh, face.linear, x, drive, tolerance=tolerance)
        return SkinPoint(q, found)

    def jacobian(self, point: SkinPoint) -> Floats:
        """Return the derivative (3 k, size of q) of the face's points by q."""
        found, flesh = point.equilibrium, self._controls.flesh
        rates = self._controls.linearise(point.q, found.x)
        motion = Response(flesh, found.factor).motions(rates)
        points = self._face.face_embedding @ motion.reshape(len(flesh.rest), -1)
        return np.asarray(points.reshape(-1, len(point.q)))

    def value(self, point: SkinPoint) -> float:
        """Return f."""
        distance = (self._distances(point) ** 2).sum() / len(self._target)
        away = point.q - self._controls.layout.rest
        return float(distance + self._options.w_rest * (away**2).sum())

    def linearise(self, point: SkinPoint) -> _BoundedModel:
        """Return f's model within the bounds."""
        layout, options = self._controls.layout, self._options
        scale, pull = np.sqrt(len(self._target)), np.sqrt(options.w_rest)
        matrix = np.vstack([self.jacobian(point) / scale, pull * np.eye(layout.size)])
        right = [-self._distances(point).ravel() / scale, pull * (layout.rest - point.q)]
        bounds = layout.lower - point.q - options.room, layout.upper - point.q + options.room
        return _BoundedModel(matrix, np.concatenate(right), bounds)

    def move(self, point: SkinPoint, step: LeastSquaresStep) -> SkinPoint | None:
        """Return the equilibrium at the end of a step."""
        try:
            return self.settle(point.q + step.change, point.equilibrium.x)
        except SolveError:  # too far: half of it may not be
            return None

    def _distances(self, point: SkinPoint) -> Floats:
        return self._face.face_points(point.equilibrium.x) - self._target


@dataclass(frozen=True)
class _BoundedModel:
    """|A s - r|^2 for a step s within ``bounds``: ``matrix`` A and ``right`` r."""

    matrix: Floats
    right: Floats
    bounds: tuple[Floats, Floats]

    def step(self, damping: float, trust: float) -> LeastSquaresStep:  # noqa: ARG002 - bounds hold it
        change = np.asarray(lsq_linear(self.matrix, self.right, self.bounds).x)
        image = self.matrix @ change
        slope, quadratic = float(-2.0 * self.right @ image), float(2.0 * image @ image)
        return LeastSquaresStep(change, slope, quadratic)
