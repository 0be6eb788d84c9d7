"""Steps of a fit's quadratic model: free, within a box, or within a set.

    min_s  g . s + s . H s / 2    with q + s within the bounds

H is small, dense and positive definite. One matrix serves many g: a model gives the ``best`` step
for any of them, and how that step is ``following`` g, what holds it at a bound holding on.

A ``linearised_step`` has m_i + dm_i/dq . s >= 0 for bounds, of all margins m_i at q. With
H = L L^T, the rows C of the bounds that the step without bounds breaks by r, and V = L^-1 C^T, the
step is that one and H^-1 C^T l, with

    min_{l >= 0}  |V l|^2 / 2 - r . l

a problem of non-negative least squares (:mod:`solver.mechanics.bounded`). Linear bounds that the
result breaks join C, and where it breaks none of these but bounds themselves, which bend, they are
cut off by their tangents at the result (Kelley 1960, "The cutting-plane method for solving convex
programs"): but for the greatest volume all bounds are concave, so that a cut takes nothing away
that is inside. That costs one factorisation of H, where an interior point
(:mod:`.interior_point`) takes some twenty.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, Protocol

import numpy as np
import scipy.linalg
from typing_extensions import override

from solver.errors import SolveError
from solver.fitting.interior_point import Bounds, InteriorPointOptions, interior_step
from solver.fitting.least_squares import Follow, bounded_step
from solver.mechanics.bounded import solve_bounded
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class LinearisedOptions:
    """The cuts, and when a step by them is good for nothing."""

    rounds: int = 10  # in which bounds are cut off
    broken: float = 1e-9  # margin below 0 from which a linear bound counts as broken ...
    outside: float = 1e-5  # ... and the bound itself, which is cut off then
    ridge: float = 1e-8  # relative, as the bounds of a muscle may depend on each other
    clearance: float = 1.02  # distance to bounds that a step keeps, by that which clipping keeps
    parts: tuple[float, ...] = (1.0, 0.5, 0.25)  # of a step, tried one after the other ...
    worth: float = 0.3  # ... until one keeps such a part of its gain, brought inside
    # promised gain, by that of the step without bounds, that no other method is tried for either
    idle: float = 1e-4


@dataclass(frozen=True)
class FeasibleStepOptions:
    """The methods within a set: the first that has a step."""

    linearised: LinearisedOptions = field(default_factory=LinearisedOptions)
    interior: InteriorPointOptions = field(default_factory=InteriorPointOptions)

    @classmethod
    def quick(cls) -> FeasibleStepOptions:
        """Return those of many fits, each from a state near by: about the best step will do."""
        return cls(interior=InteriorPointOptions(fall=0.03, short=1e-2))


class StepModel(Protocol):
    """The quadratic models of one matrix H (size, size) from one q (size,)."""

    def best(self, gradient: Floats) -> Floats:
        """Return the feasible s (size,) that minimises the model of a ``gradient`` (size,).

        Raises :class:`SolveError` (``solve.not_finite``) where H is not positive definite.
        """

    def following(self) -> Follow:
        """Return how the best step follows the gradient, from what holds it at the bounds."""


@dataclass(frozen=True)
class FreeSteps(StepModel):
    """Steps without bounds."""

    hessian: Floats

    @override
    def best(self, gradient: Floats) -> Floats:
        return -self._follow(gradient)

    @override
    def following(self) -> Follow:
        return self._follow

    @cached_property
    def _follow(self) -> Follow:
        return partial(_solve, _factorise(self.hessian))


@dataclass(frozen=True)
class BoxSteps(StepModel):
    """Steps within ``limits`` (size,), the least and the greatest."""

    hessian: Floats
    gradient: Floats  # about whose best step the others follow
    limits: tuple[Floats, Floats]

    @override
    def best(self, gradient: Floats) -> Floats:
        return bounded_step(self.hessian, gradient, self.limits)

    @override
    def following(self) -> Follow:
        return self._follow

    @cached_property
    def _follow(self) -> Follow:
        lower, upper = self.limits
        ahead = self.best(self.gradient)
        # at a bound that the step would leave, it stays
        held = ((ahead == lower) | (ahead == upper)) & (ahead == 0.0)
        open_ = np.flatnonzero(~held)
        factor = _factorise(self.hessian[np.ix_(open_, open_)])

        def follow(change: Floats) -> Floats:
            out = np.zeros_like(change)
            out[open_] = _solve(factor, change[open_])
            return out

        return follow


@dataclass(frozen=True)
class SetSteps(StepModel):
    """Steps from q within ``bounds`` of the muscles' set."""

    bounds: Bounds
    hessian: Floats
    gradient: Floats  # about whose best step the others follow
    q: Floats
    options: FeasibleStepOptions

    @override
    def best(self, gradient: Floats) -> Floats:
        own = gradient is self.gradient
        found = self._linearised if own else self._linearised_step(gradient)
        if found is not None:
            return found.change
        model = self.bounds, self.hessian, gradient, self.q
        inside = interior_step(*model, self.options.interior).change
        return self.bounds.clip(self.q + inside) - self.q

    @override
    def following(self) -> Follow:
        return self._follow

    @cached_property
    def _follow(self) -> Follow:
        found = self._linearised
        if found is not None:
            return found.follow
        model = self.bounds, self.hessian, self.gradient, self.q
        ahead = interior_step(*model, self.options.interior)
        return partial(_solve, _factorise(self.hessian + ahead.curvature))

    @cached_property
    def _linearised(self) -> LinearisedStep | None:
        return self._linearised_step(self.gradient)

    def _linearised_step(self, gradient: Floats) -> LinearisedStep | None:
        model = self.bounds, self.hessian, gradient, self.q
        return linearised_step(*model, self.options.linearised)


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


# The step within bounds that are made linear, by cutting planes.


@dataclass(frozen=True)
class LinearisedStep:
    """A step (size,), with L of the Hessian (size, size) and V (size, k) of what holds it."""

    change: Floats
    root: Floats
    active: Floats
    ridge: float

    def follow(self, change: Floats) -> Floats:
        """Return L^-T (1 - V (V^T V)^-1 V^T) L^-1 r for r (size,)."""
        pull = _solve_triangular(self.root, change)
        held = _solve_triangular(self._triangle, self.active.T @ pull)
        pull -= self.active @ _solve_triangular(self._triangle, held, trans="T")
        return _solve_triangular(self.root, pull, trans="T")

    @cached_property
    def _triangle(self) -> Floats:
        return _root_of_square(self.active, self.ridge)


def linearised_step(
    bounds: Bounds,
    hessian: Floats,
    gradient: Floats,
    q: Floats,
    options: LinearisedOptions = LinearisedOptions(),
) -> LinearisedStep | None:
    """Return about the best step (size,) from q (size,), its end being inside the bounds.

    Where q is outside it begins at the nearest that is not. None where cuts do not lead to what is
    inside. ``hessian`` H is (size, size), ``gradient`` g (size,). Raises
    :class:`SolveError` (``solve.not_finite``) where H is not positive definite, or anything is not
    finite.
    """
    try:
        # in the order that LAPACK has, which spares a transposed copy
        root = scipy.linalg.cholesky(hessian.T, lower=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error
    free = -scipy.linalg.cho_solve((root, True), gradient, check_finite=False)
    if not np.isfinite(free).all():
        raise SolveError("solve.not_finite", "no Gauss-Newton step: it is not finite")
    unbounded = gradient
    begin = q
    entered = np.zeros_like(q)
    if not bounds.contains(q):
        begin = bounds.clip(q)
        entered = begin - q
        gradient = gradient + hessian @ entered
    try:
        ahead = _cut_step(bounds, begin, root, free - entered, options)
    except np.linalg.LinAlgError:  # too many bounds that depend on each other
        return None
    step, active, is_certain = ahead
    promised = _gain(step, root, gradient)
    if promised <= 0.0:
        return LinearisedStep(entered, root, active, options.ridge) if is_certain else None
    least = options.worth * promised
    for part in options.parts:
        inside = bounds.clip(begin + part * step) - begin
        if _gain(inside, root, gradient) >= least:
            return LinearisedStep(entered + inside, root, active, options.ridge)
    if promised <= options.idle * _gain(free, root, unbounded):
        return LinearisedStep(entered, root, active, options.ridge)
    return None


def _gain(step: Floats, root: Floats, gradient: Floats) -> float:
    along = scipy.linalg.blas.dtrmv(root, step, lower=1, trans=1)
    return -float(step @ gradient + 0.5 * along @ along)


def _cut_step(
    bounds: Bounds, q: Floats, root: Floats, free: Floats, options: LinearisedOptions
) -> tuple[Floats, Floats, bool]:
    """Return the step from q (size,) within bounds made linear, and V of those that hold it.

    The last tells whether none inside gains more: it is broken no more, and held by no cut, which
    may take away what is inside. ``free`` is the step without bounds, ``root`` is L.
    """
    assert bounds.feasible is not None, "a box is kept by bounded least squares"
    at_q = bounds.feasible.margins(q[bounds.muscles])
    # what is clipped would go back so far
    kept = np.minimum(at_q, options.clearance * bounds.clipped * bounds.feasible.at_rest)
    tangent = _LinearBounds(bounds, q, kept)
    step = free
    held = _HeldStep(root, free, options.ridge)
    for _ in range(options.rounds):
        linear, at = tangent, np.zeros_like(step)
        beyond = np.flatnonzero(tangent.margins(step) < -options.broken)
        joining = np.setdiff1d(beyond, held.numbers)
        numbers = joining
        if len(joining) == 0:
            linear, at = _LinearBounds(bounds, q + step, kept), step
            joining = np.flatnonzero(linear.at_q < -options.outside)
            numbers = np.full(len(joining), -1)
        if len(joining) == 0:
            return step, held.rows.T, bool((held.numbers >= 0).all())
        step = held.join(numbers, linear.rows(joining), -linear.margins(free - at)[joining])
    return step, held.rows.T, False


class _HeldStep:
    """The step that linear bounds hold: those that do, k of all that have joined.

    Their ``numbers`` (k,) are those of tangent bounds, -1 of cuts; the ``rows`` V^T (k, size) have
    the length 1. ``root`` is L, ``free`` (size,) the step without bounds.
    """

    def __init__(self, root: Floats, free: Floats, ridge: float) -> None:
        self.numbers = np.zeros(0, np.int64)
        self.rows = np.zeros((0, len(free)))
        self._broken = np.zeros(0)
        self._gram = np.zeros((0, 0))  # V^T V
        self._root = root
        self._free = free
        self._ridge = ridge

    def join(self, numbers: Ints, rows: Floats, broken: Floats) -> Floats:
        """Return the step (size,) held by further bounds C (n, size), ``broken`` by the free one.

        Those that do not hold it are forgotten. Raises ``LinAlgError`` where too many depend on
        each other.
        """
        new = _solve_triangular(self._root, rows.T).T
        length = np.sqrt(np.einsum("ki,ki->k", new, new))
        new /= length[:, None]
        across = self.rows @ new.T
        self._gram = np.block([[self._gram, across], [across.T, new @ new.T]])
        self.rows = np.vstack([self.rows, new])
        self._broken = np.append(self._broken, broken / length)
        self.numbers = np.append(self.numbers, numbers)
        multipliers = self._multipliers()
        step = self._free + _solve_triangular(self._root, multipliers @ self.rows, trans="T")
        holds = np.flatnonzero(multipliers > 0.0)
        self.rows = self.rows[holds]
        self._broken = self._broken[holds]
        self._gram = self._gram[np.ix_(holds, holds)]
        self.numbers = self.numbers[holds]
        return step

    def _multipliers(self) -> Floats:
        """Return the l (k,)."""
        count = len(self.numbers)
        matrix = self._gram + self._ridge * np.eye(count)
        found = np.zeros(count)
        side = np.zeros(count, np.int8)  # all hold, as a guess
        limits = np.zeros(count), np.full(count, np.inf)
        ended = solve_bounded(matrix, self._broken, *limits, side, found)
        if not (ended and np.isfinite(found).all()):
            raise np.linalg.LinAlgError("bounds depend on each other")
        return found


def _root_of_square(columns: Floats, ridge: float) -> Floats:
    """Return the lower triangular root (k, k) of V^T V for V (size, k)."""
    matrix = columns.T @ columns
    matrix[np.diag_indices_from(matrix)] *= 1.0 + ridge
    return np.asarray(scipy.linalg.cholesky(matrix, lower=True, check_finite=False))


def _solve_triangular(root: Floats, right: Floats, trans: Literal["N", "T"] = "N") -> Floats:
    """Return root^-1 r, of the lower triangular ``root`` or its transpose, both being finite."""
    found = scipy.linalg.solve_triangular(root, right, lower=True, trans=trans, check_finite=False)
    return np.asarray(found)


class _LinearBounds:
    """The margins of bounds by steps from q, to first order: the muscles' set, then the box.

    ``kept`` (m, bounds) of the set's margins are not there to be used up.
    """

    def __init__(self, bounds: Bounds, q: Floats, kept: Floats) -> None:
        assert bounds.feasible is not None, "a box is kept by bounded least squares"
        self._bounds = bounds
        margins, self._slopes = bounds.feasible.linearise(q[bounds.muscles])
        margins = margins - kept
        margins[~np.isfinite(margins)] = np.inf  # of volume, where a stretch is negative
        self.at_q = np.concatenate([margins.ravel(), bounds.room(q)])

    def margins(self, step: Floats) -> Floats:
        """Return the margins (n,) after a step (size,)."""
        by_muscle = np.einsum("jbk,jk->jb", self._slopes, step[self._bounds.muscles])
        low, high = self._bounds.bounded_places
        change = np.concatenate([by_muscle.ravel(), step[low], -step[high]])
        return np.asarray(self.at_q + change)

    def rows(self, chosen: Ints) -> Floats:
        """Return the derivatives (k, size) of the ``chosen`` (k,) margins by a step."""
        count = len(self._bounds.muscles)
        size = self._slopes.shape[2]
        own = chosen[chosen < count * self._slopes.shape[1]]
        out = np.zeros((len(chosen), len(self._bounds.lower)))
        places = self._bounds.muscles[own // self._slopes.shape[1]]
        out[np.arange(len(own))[:, None], places] = self._slopes.reshape(-1, size)[own]
        places, signs = self._box
        box = chosen[len(own) :] - count * self._slopes.shape[1]
        out[np.arange(len(own), len(chosen)), places[box]] = signs[box]
        return out

    @cached_property
    def _box(self) -> tuple[Ints, Floats]:
        """Places of the bounded entries, and the slopes of their room."""
        low, high = self._bounds.bounded_places
        return np.concatenate([low, high]), np.repeat([1.0, -1.0], [len(low), len(high)])
