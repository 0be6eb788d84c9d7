"""Steps of a fit's quadratic model: free, within a box, or within a set.

    min_s  g . s + s . H s / 2    with q + s within the bounds

H is small, dense and positive definite. One matrix serves many g: a model gives the ``best`` step
for any of them, and ``follow``, how that step changes with g, what holds it at a bound holding on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg

from solver.errors import SolveError
from solver.fitting.interior_point import Bounds, InteriorPointOptions, interior_step
from solver.fitting.least_squares import bounded_step
from solver.fitting.linearised_step import LinearisedOptions, linearised_step
from solver.surface import Floats


@dataclass(frozen=True)
class StepOptions:
    """The methods within a set: the first that has a step."""

    linearised: LinearisedOptions | None = None  # from frame to frame, where steps are short
    interior: InteriorPointOptions = field(default_factory=InteriorPointOptions)

    @classmethod
    def quick(cls) -> StepOptions:
        """Return those of many fits, each from a state near by: about the best step will do."""
        return cls(LinearisedOptions(), InteriorPointOptions(fall=0.03, short=1e-2))


class StepModel(Protocol):
    """The quadratic models of one matrix H (size, size) from one q (size,)."""

    def best(self, gradient: Floats) -> Floats:
        """Return the feasible s (size,) that minimises the model of a ``gradient`` (size,).

        Raises :class:`SolveError` (``solve.not_finite``) where H is not positive definite.
        """

    def follow(self, change: Floats) -> Floats:
        """Return B^-1 r (size,): minus what the best step changes by for r more in the gradient."""


def step_model(
    bounds: Bounds,
    hessian: Floats,
    gradient: Floats,
    q: Floats,
    longest: Floats,
    options: StepOptions = StepOptions(),
) -> StepModel:
    """Return the steps from q within ``bounds``, those in a box no longer than ``longest`` (size,).

    ``gradient`` is that which :meth:`StepModel.follow` linearises the best step about.
    """
    if bounds.feasible is not None:
        return _SetSteps(bounds, hessian, gradient, q, options)
    if bounds.is_box:
        limits = np.maximum(bounds.lower - q, -longest), np.minimum(bounds.upper - q, longest)
        return _BoxSteps(hessian, gradient, limits)
    return _FreeSteps(hessian)


@dataclass(frozen=True)
class _FreeSteps:
    hessian: Floats

    def best(self, gradient: Floats) -> Floats:
        return -self.follow(gradient)

    def follow(self, change: Floats) -> Floats:
        return _solve(self._factor, change)

    @cached_property
    def _factor(self) -> Any:
        return _factorise(self.hessian)


@dataclass(frozen=True)
class _BoxSteps:
    hessian: Floats
    gradient: Floats
    limits: tuple[Floats, Floats]

    def best(self, gradient: Floats) -> Floats:
        return bounded_step(self.hessian, gradient, self.limits)

    def follow(self, change: Floats) -> Floats:
        # at a bound that the step would leave, it stays
        open_, factor = self._open
        out = np.zeros_like(change)
        out[open_] = _solve(factor, change[open_])
        return out

    @cached_property
    def _open(self) -> tuple[np.ndarray, Any]:
        lower, upper = self.limits
        ahead = self.best(self.gradient)
        held = ((ahead == lower) | (ahead == upper)) & (ahead == 0.0)
        open_ = np.flatnonzero(~held)
        return open_, _factorise(self.hessian[np.ix_(open_, open_)])


@dataclass(frozen=True)
class _SetSteps:
    bounds: Bounds
    hessian: Floats
    gradient: Floats
    q: Floats
    options: StepOptions

    def best(self, gradient: Floats) -> Floats:
        model, options = (self.bounds, self.hessian, gradient, self.q), self.options
        found = None
        if options.linearised is not None:
            found = linearised_step(*model, options.linearised)
        return interior_step(*model, options.interior).change if found is None else found

    def follow(self, change: Floats) -> Floats:
        return _solve(self._factor, change)

    @cached_property
    def _factor(self) -> Any:
        model = self.bounds, self.hessian, self.gradient, self.q
        ahead = interior_step(*model, self.options.interior)
        return _factorise(self.hessian + ahead.curvature)


def _factorise(matrix: Floats) -> Any:
    try:
        return scipy.linalg.cho_factor(matrix)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error


def _solve(factor: Any, right: Floats) -> Floats:
    try:
        return np.asarray(scipy.linalg.cho_solve(factor, right))
    except ValueError as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Return the solution (size,) of a positive definite system.

    Raises :class:`SolveError` (``solve.not_finite``) where there is none.
    """
    return _solve(_factorise(matrix), right)
