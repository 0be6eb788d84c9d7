"""Minimise a fit's quadratic model over admissible controls, by an interior-point method.

    min_s  g . s + s . H s / 2    with q + s admissible

with H small, dense and positive definite: Newton's method on the model and the barrier of the
bounds, whose weight falls (Nocedal and Wright 2006, chapter 19). The equilibrium, which is dear,
plays no part in it: a fit linearises the face, solves this to its end, and has a step that is the
best of all admissible ones, as sequential quadratic programming does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg

from solver.errors import SolveError
from solver.surface import Floats, Ints


class FeasibleSet(Protocol):
    """The values a (m, k) that m muscles can take, with the logarithmic barrier of that set."""

    @property
    def at_rest(self) -> Floats:
        """The margins (m, bounds) of muscles at rest."""

    def margins(self, a: Floats) -> Floats:
        """Return how far ``a`` is inside every bound, (m, bounds): above 0 if it is."""

    def linearise(self, a: Floats) -> tuple[Floats, Floats]:
        """Return the margins, and their derivatives (m, bounds, k) by each muscle's own values."""

    def nearest(self, a: Floats, kept: float) -> Floats:
        """Return values (m, k) near ``a`` that keep a part of the margins at rest."""

    def value(self, a: Floats) -> float:
        """Return the barrier, infinite on a bound and beyond."""

    def gradient(self, a: Floats) -> Floats:
        """Return the barrier's derivative (m, k)."""

    def hessian(self, a: Floats) -> Floats:
        """Return the barrier's positive semi-definite second derivative (m, k, k)."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of controls q (size,): a box, and a set that the muscles' entries stay in, if any."""

    lower: Floats  # (size,)
    upper: Floats  # (size,)
    muscles: Ints  # (m, k): where the controls of each muscle are in q
    feasible: FeasibleSet | None = None
    clipped: float = 1e-4  # distance to the set's bounds of what is brought inside, by that at rest

    @cached_property
    def is_box(self) -> bool:
        """Tell whether any entry has a bound of its own."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @property
    def is_free(self) -> bool:
        """Tell whether there are no bounds of either sort."""
        return not self.is_box and self.feasible is None

    @cached_property
    def bounded_places(self) -> tuple[Ints, Ints]:
        """Places of the entries with a lower and with an upper bound of their own."""
        return np.flatnonzero(np.isfinite(self.lower)), np.flatnonzero(np.isfinite(self.upper))

    def room(self, q: Floats) -> Floats:
        """Return the distances of q (size,) to the box: to lower bounds, then to upper ones."""
        low, high = self.bounded_places
        return np.concatenate([q[low] - self.lower[low], self.upper[high] - q[high]])

    def contains(self, q: Floats) -> bool:
        """Tell whether the muscles' entries of q (size,) are inside their set."""
        return self.feasible is None or bool((self.feasible.margins(q[self.muscles]) > 0.0).all())

    def keep(self, q: Floats, step: Floats) -> Floats:
        """Return a part of a step from q (size,), brought inside.

        Between two admissible ends a muscle may have more volume than at either.
        """
        return step if self.contains(q + step) else self.clip(q + step) - q

    def clip(self, q: Floats) -> Floats:
        """Return q (size,) within the bounds."""
        out = np.clip(q, self.lower, self.upper) if self.is_box else q
        if self.feasible is None:
            return out
        out = out.copy()
        out[self.muscles] = self.feasible.nearest(out[self.muscles], self.clipped)
        return out


@dataclass(frozen=True)
class InteriorPointOptions:
    """Weights of the barrier, and Newton's method for each."""

    fall: float = 0.1  # of the weight, from that at which all bounds weigh as much as the model
    short: float = 1e-5  # part of its gain that a step may be short of at the end
    weights: int = 40  # at most
    steps: int = 15  # for one weight
    decrement: float = 0.5  # of the last step for a weight, by that weight
    entered: float = 0.05  # distance to every bound at the start, by that at rest
    one_sided: float = 1.0  # room within a bound without another one opposite
    kept: float = 0.1  # part of the distance to a bound that a step leaves
    backtrack: float = 0.7
    tries: int = 40
    gained: float = 1e-4  # least gain of a step, by what its slope promises (Armijo 1966)


@dataclass(frozen=True)
class InteriorStep:
    """A step (size,), and the barrier's second derivative at it or a step before, (size, size)."""

    change: Floats
    curvature: Floats


def interior_step(
    bounds: Bounds,
    hessian: Floats,
    gradient: Floats,
    q: Floats,
    options: InteriorPointOptions = InteriorPointOptions(),
) -> InteriorStep:
    """Return the best step from q (size,), which need not be admissible itself.

    ``hessian`` H is (size, size), ``gradient`` g (size,). Raises :class:`SolveError`
    (``solve.not_finite``) where H is not positive definite, or anything is not finite.
    """
    barrier = _Barrier(bounds, options)
    try:
        step = barrier.nearest(q) - q
        slope = gradient + hessian @ step
        newton = scipy.linalg.cho_solve(scipy.linalg.cho_factor(hessian), slope)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error
    count = len(barrier.margins(q))
    weight = 0.5 * float(slope @ newton) / count
    curvature = np.zeros_like(hessian)
    first = _BarrierModel(barrier, hessian, gradient, q, weight)
    begin = first.quadratic(step)
    for _ in range(options.weights):
        # of no bound is there more to gain
        if count * weight <= options.short * (begin - first.quadratic(step)):
            break
        try:
            step, curvature = _descend(replace(first, weight=weight), step, options)
        except np.linalg.LinAlgError:
            # a bound is so near that rounding hides the model behind it
            break
        weight *= options.fall
    return InteriorStep(step, curvature)


def _descend(
    model: _BarrierModel, step: Floats, options: InteriorPointOptions
) -> tuple[Floats, Floats]:
    """Return the step that minimises the model with its barrier, and the barrier's curvature."""
    for _ in range(options.steps):
        curvature = model.weight * model.barrier.hessian(model.q + step)
        factor = scipy.linalg.cho_factor(model.hessian + curvature)
        slope = model.gradient(step)
        direction = -scipy.linalg.cho_solve(factor, slope)
        decrement = -float(slope @ direction)
        if decrement <= options.decrement * model.weight:
            break
        step = _search(model, step, direction, decrement, options)
    return step, curvature


@dataclass(frozen=True)
class _BarrierModel:
    """The quadratic model with a barrier of some weight."""

    barrier: _Barrier
    hessian: Floats
    linear: Floats
    q: Floats
    weight: float

    def quadratic(self, step: Floats) -> float:
        return float(self.linear @ step + 0.5 * step @ self.hessian @ step)

    def value(self, step: Floats) -> float:
        return self.quadratic(step) + self.weight * self.barrier.value(self.q + step)

    def gradient(self, step: Floats) -> Floats:
        by_barrier = self.barrier.gradient(self.q + step)
        return np.asarray(self.linear + self.hessian @ step + self.weight * by_barrier)


def _search(
    model: _BarrierModel,
    step: Floats,
    direction: Floats,
    decrement: float,
    options: InteriorPointOptions,
) -> Floats:
    """Return a step further along ``direction`` that lowers the model and stays inside."""
    least = options.kept * model.barrier.margins(model.q + step)
    before = model.value(step)
    part = 1.0
    for _ in range(options.tries):
        trial = step + part * direction
        inside = (model.barrier.margins(model.q + trial) >= least).all()
        if inside and model.value(trial) <= before - options.gained * part * decrement:
            return trial
        part *= options.backtrack
    return step


class _Barrier:
    """The barrier of bounds: of the muscles' set, and of the other entries' box."""

    def __init__(self, bounds: Bounds, options: InteriorPointOptions) -> None:
        if bounds.feasible is None:
            raise ValueError("bounds without a feasible set have no barrier")
        self._bounds = bounds
        self._options = options
        self._muscles = bounds.muscles
        self._within = bounds.feasible

    def margins(self, q: Floats) -> Floats:
        """Return the distances to all bounds."""
        of_muscles = self._within.margins(q[self._muscles])
        return np.concatenate([of_muscles.ravel(), self._bounds.room(q)])

    def nearest(self, q: Floats) -> Floats:
        """Return controls inside the bounds."""
        out = q.copy()
        bounds = self._bounds
        options = self._options
        out[self._muscles] = self._within.nearest(q[self._muscles], options.entered)
        room = np.nan_to_num(bounds.upper - bounds.lower, posinf=options.one_sided)
        room *= 0.5 * options.entered
        return np.clip(out, bounds.lower + room, bounds.upper - room)

    def value(self, q: Floats) -> float:
        """Return the barrier."""
        room = self._bounds.room(q)
        if not (room > 0.0).all():
            return np.inf
        return self._within.value(q[self._muscles]) - float(np.log(room).sum())

    def gradient(self, q: Floats) -> Floats:
        """Return its derivative (size,)."""
        (low, high), out = self._bounds.bounded_places, np.zeros_like(q)
        out[self._muscles] = self._within.gradient(q[self._muscles])
        out[low] -= 1.0 / (q[low] - self._bounds.lower[low])
        out[high] += 1.0 / (self._bounds.upper[high] - q[high])
        return out

    def hessian(self, q: Floats) -> Floats:
        """Return its second derivative (size, size), positive semi-definite."""
        low, high = self._bounds.bounded_places
        diagonal = np.zeros_like(q)
        diagonal[low] += (q[low] - self._bounds.lower[low]) ** -2
        diagonal[high] += (self._bounds.upper[high] - q[high]) ** -2
        out = np.diag(diagonal)
        places = self._muscles
        out[places[:, :, None], places[:, None, :]] = self._within.hessian(q[places])
        return out
