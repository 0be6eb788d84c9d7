"""Quasi-static equilibrium: grad_x E(x; A, b) = 0 by Newton's method.

Near the solution the raw Hessian gives quadratic convergence. Far from it, and where it is not
positive definite, it is projected, no further than need be. A line search keeps the energy finite,
hence every tet upright. Where a Hessian from nearby still serves, its chord steps do instead, with
Anderson's acceleration: one costs a fraction of a new factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from solver.errors import SolveError
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import Factor, LinearSolver, NotPositiveDefiniteError
from solver.mechanics.materials.volumetric import BARRIER_START
from solver.surface import Floats

# Anderson's acceleration of corrections with an old stiffness.
#
# Walker and Ni (2011), Anderson acceleration for fixed-point iterations: the corrections so far
# tell in which few modes the stiffness is wrong.


KEPT = 8
"""Corrections that it looks back on."""


class Accelerator:
    """Takes points (size,) with the corrections (size,) there, and makes better corrections."""

    def __init__(self) -> None:
        self._points: list[Floats] = []
        self._corrections: list[Floats] = []

    def step(self, point: Floats, correction: Floats) -> Floats:
        """Return the step from ``point``, the ``correction`` there itself if it is the first."""
        self._points = [*self._points[-KEPT:], point]
        self._corrections = [*self._corrections[-KEPT:], correction]
        if len(self._points) < 2:
            return correction
        changes = np.diff(self._corrections, axis=0).T
        # they get shorter by orders of magnitude: all count alike
        scale = np.linalg.norm(changes, axis=0)
        if not (np.isfinite(scale).all() and scale.all()):
            return correction
        weights = np.linalg.lstsq(changes / scale, correction, rcond=1e-6)[0] / scale
        return np.asarray(correction - (np.diff(self._points, axis=0).T + changes) @ weights)


TOLERANCE = 1e-7
"""Residual |grad E| over the nodal forces at unit strain."""

STALLED = 1e-5
"""Residual at which a solve that can get no further still counts."""

MAX_ITERATIONS = 100
ARMIJO = 1e-4
SHORTEST_STEP = 2.0**-30
GROWTH = 4.0

CRUSHED = 1e-3
"""det F below which a tet is too stiff for its neighbours to be solved for."""

SHARES = (0.0, 0.05, 0.15, 0.4, 1.0)
"""How far the Hessian is projected, one after the other, until it is positive definite."""

FAR = 0.3
"""Residual from which on a start is not worth trying with less than the whole projection."""

NARROWEST = 0.1
"""No step makes a tet's det F smaller than this part of what it was: a crushed tet opens slowly."""

REACH_MM = 0.3
"""A Newton step no longer than this is taken to end in the equilibrium."""

CORRECTIONS = 6
"""Newton steps of an approach at most."""

CONTRACTION = 0.3
"""Part of the step's length that the next chord step has at most, where it is of any use."""

COASTING = 0.7
"""Part of the residual that an accelerated chord step leaves at most: it costs a fifth to an eighth
of a factorisation, and most simulated expressions need none."""

SETTLED_MM, CHORDS = 0.02, 3
"""Chord steps end an approach: until the next is shorter than the one, the other at most."""

SAME_MM = 1e-3
"""Motion over which a factorised Hessian counts as the one here."""


class Stiffness:
    """The Hessian at x (p, 3) with activations ``a`` (n, 6), factorised when first asked for.

    ``first`` is the first of the :data:`SHARES` to be tried.
    """

    def __init__(
        self, flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats, first: int = 0
    ) -> None:
        self.x = x
        self._problem = flesh, linear, x, a, first

    def solve(self, B: Floats) -> Floats:
        """See :class:`~solver.mechanics.linear.Factor`."""
        return self._factorised[0].solve(B)

    @property
    def share(self) -> int:
        """Return the number of the share by which the Hessian had to be projected."""
        return self._factorised[1]

    @cached_property
    def _factorised(self) -> tuple[Factor, int]:
        return factorise(*self._problem)


@dataclass(frozen=True)
class Equilibrium:
    """Vertices x (p, 3) with the factorised Hessian there, and what Newton's next step leads to.

    ``estimate`` (p, 3) is that step's end: the equilibrium to second order, x itself where that is
    solved. ``factor`` is the Hessian's at x, or where it served last on the way: about
    :data:`REACH_MM` away at most, :data:`SAME_MM` where solved (:class:`Lagged` has its own from
    further away). ``residual`` is |grad E| over the nodal forces at unit strain,
    ``iterations`` counts Newton steps.
    """

    x: Floats
    estimate: Floats
    factor: Stiffness
    residual: float
    iterations: int

    @property
    def minimum(self) -> bool:
        """Tell whether the Hessian is positive definite as it is (else it has been projected)."""
        return self.factor.share == 0


def factorise(
    flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats, first: int = 0
) -> tuple[Factor, int]:
    """Factorise the Hessian at x, projected as far as need be; tell which of the SHARES it took.

    The first of :data:`SHARES` to be tried is number ``first``; 0 is the Hessian itself. Near
    buckling a small share is often enough, and keeps more of Newton's speed than all of it.

    Raises :class:`SolveError`: ``solve.crushed`` where a tet has next to no volume left, else
    ``solve.singular``.
    """
    for number in range(first, len(SHARES)):
        matrix = flesh.hessian(x, a, project=SHARES[number])
        if number:
            # a projected element may be semi-definite: a trace of stiffness keeps the sum definite
            diagonal = flesh.diagonal
            matrix.data[diagonal] += 1e-6 * SHARES[number] * matrix.data[diagonal].mean()
        try:
            return linear.factor(matrix.data), number
        except NotPositiveDefiniteError:
            pass
    openings = flesh.openings(x)
    flattest = int(openings.argmin())
    if openings[flattest] < CRUSHED:
        place = np.round(flesh.rest[flesh.tets[flattest]].mean(axis=0))
        raise SolveError(
            "solve.crushed",
            f"the flesh around {place.tolist()} is crushed: what holds it has come together there",
            tet=flattest,
            place_mm=place.tolist(),
        )
    raise SolveError(
        "solve.singular", "the flesh's stiffness is singular: a part of it is held by nothing"
    )


def solve(
    flesh: Flesh,
    linear: LinearSolver,
    x: Floats,
    a: Floats,
    *,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
    near: Stiffness | None = None,
) -> Equilibrium:
    """Minimise E over the free vertices from ``x`` (p, 3), held vertices staying where they are.

    ``near`` is the stiffness of a state nearby, which is tried first. Raises :class:`SolveError`:
    ``solve.inverted`` if a tet is inverted at the start, ``solve.no_convergence`` if it stops at a
    residual above both ``tolerance`` and ``STALLED``.
    """
    _check_upright(flesh, x, a)
    stiffness, share = near, -1
    for iteration in range(max_iterations + 1):
        gradient = flesh.gradient(x, a)
        if stiffness is not None:
            x, gradient = _coast(flesh, x, a, stiffness, gradient, tolerance)
        residual = _residual(flesh, gradient)
        if residual <= tolerance or iteration == max_iterations:
            break
        newton = Stiffness(flesh, linear, x, a, _first_share(residual, share))
        share = newton.share
        step = _line_search(flesh, x, a, newton.solve(-gradient), gradient, share > 0)
        if step is None:
            break
        x, length = step
        # what is projected, or led only part of the way, is no good a second time
        stiffness = newton if share == 0 and length == 1.0 else None
    # NaN, too, is no equilibrium
    if not residual <= max(tolerance, STALLED):
        raise SolveError(
            "solve.no_convergence",
            f"equilibrium stopped at a residual of {residual:.1e} after {iteration} steps",
            residual=residual,
        )
    if stiffness is None or np.abs(stiffness.x - x).max() > SAME_MM:
        stiffness = Stiffness(flesh, linear, x, a)
    return Equilibrium(x, x, stiffness, residual, iteration)


def approach(
    flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats, settled_mm: float = SETTLED_MM
) -> Equilibrium:
    """Take Newton steps from ``x`` (p, 3) until the next one is shorter than :data:`REACH_MM`.

    Then chord steps follow, :data:`CHORDS` at most, until the next is shorter than ``settled_mm``.
    Inside a fit that is near enough: ``estimate`` is what it compares with its target. Raises
    :class:`SolveError`: ``solve.inverted``, or ``solve.far`` after :data:`CORRECTIONS` steps.
    """
    _check_upright(flesh, x, a)
    share = -1
    for iteration in range(CORRECTIONS + 1):
        gradient = flesh.gradient(x, a)
        residual = _residual(flesh, gradient)
        stiffness = Stiffness(flesh, linear, x, a, _first_share(residual, share))
        share = stiffness.share
        direction = stiffness.solve(-gradient)
        if np.abs(direction).max() <= REACH_MM:
            estimate = flesh.moved(x, direction)
            found = Equilibrium(x, estimate, stiffness, residual, iteration)
            return _polish(flesh, a, found, settled_mm)
        step = _line_search(flesh, x, a, direction, gradient, share > 0)
        if step is None:
            break
        x, _ = step
    raise SolveError("solve.far", "the equilibrium is too far for a few steps")


def _check_upright(flesh: Flesh, x: Floats, a: Floats) -> None:
    if not np.isfinite(flesh.energy(x, a)):
        raise SolveError(
            "solve.inverted", f"{flesh.inverted(x)} tetrahedra are inverted before the first step"
        )


def _residual(flesh: Flesh, gradient: Floats) -> float:
    return float(np.linalg.norm(gradient)) / flesh.force_scale


def _coast(
    flesh: Flesh, x: Floats, a: Floats, stiffness: Stiffness, gradient: Floats, tolerance: float
) -> tuple[Floats, Floats]:
    """Return where accelerated chord steps lead as the residual falls, and the gradient there.

    An equilibrium that is unstable but perfectly symmetric is one to them, too: the slightest
    asymmetry, 1e-4 mm of a column, leads away from it, and ``minimum`` tells.
    """
    accelerator = Accelerator()
    while _residual(flesh, gradient) > tolerance:
        correction = stiffness.solve(-gradient)
        trial = flesh.moved(x, accelerator.step(x[flesh.free].ravel(), correction))
        if flesh.narrowing(x, trial) < NARROWEST:
            break
        after = flesh.gradient(trial, a)
        # NaN is no progress either
        if not np.linalg.norm(after) <= COASTING * np.linalg.norm(gradient):
            break
        x, gradient = trial, after
    return x, gradient


def _polish(flesh: Flesh, a: Floats, now: Equilibrium, settled_mm: float) -> Equilibrium:
    """Follow an estimate by chord steps that get shorter."""
    for _ in range(CHORDS):
        length = np.abs(now.estimate - now.x).max()
        if length <= settled_mm or flesh.narrowing(now.x, now.estimate) < NARROWEST:
            break
        gradient = flesh.gradient(now.estimate, a)
        direction = now.factor.solve(-gradient)
        if np.abs(direction).max() > CONTRACTION * length:
            break
        estimate = flesh.moved(now.estimate, direction)
        residual = _residual(flesh, gradient)
        now = replace(now, x=now.estimate, estimate=estimate, residual=residual)
    return now


def _first_share(residual: float, last: int) -> int:
    """Return the share to try first; ``last`` is what the step before took, -1 if there is none."""
    if residual <= TOLERANCE:
        return 0
    if last < 0:
        return len(SHARES) - 1 if residual > FAR else 0
    return max(last - 1, 0)


def _line_search(
    flesh: Flesh, x: Floats, a: Floats, direction: Floats, gradient: Floats, grow: bool
) -> tuple[Floats, float] | None:
    """Halve the step until the energy falls enough (Armijo); None if it does not fall at all.

    With ``grow`` a full step that does is made longer while the energy goes on falling: where flesh
    buckles, at a saddle, the projected Hessian is too stiff. Returns the end and the step's length,
    1 being the whole ``direction``.
    """
    energy, slope = flesh.energy(x, a), float(gradient @ direction)

    def tried(step: float) -> tuple[Floats, float] | None:
        trial = flesh.moved(x, step * direction)
        if flesh.narrowing(x, trial) < NARROWEST:
            return None
        value = flesh.energy(trial, a)
        # rounding decides once the predicted decrease is below the energy's last digits
        enough = value <= energy + ARMIJO * step * slope + 1e-13 * abs(energy)
        return (trial, value) if enough else None

    step = 1.0
    found = tried(step)
    while found is None and step > SHORTEST_STEP:
        step *= 0.5
        found = tried(step)
    while grow and found is not None and step >= 1.0:
        longer = tried(GROWTH * step)
        if longer is None or longer[1] >= found[1]:
            break
        found, step = longer, GROWTH * step
    return found and (found[0], step)


# Equilibrium near a known one: Newton's method with a stiffness from somewhere near.
#
# A factorisation costs as much as several corrections with an old one. So these go on while they
# get shorter, with Anderson's acceleration: it finds the few modes in which the old stiffness is
# wrong.


LONG_MM, CLOSE_MM = 0.75, 0.2
"""A longer correction asks for a new stiffness; the end of a shorter one is good enough."""

LAGGED_CONTRACTION = 1.2
"""A correction that is as many times as long as the one before asks for a new stiffness too: an
accelerated one may be longer now and then."""

LAGGED_CORRECTIONS = 8
FACTORISATIONS = 5
PARTS = (1.0, 0.5, 0.25, 0.125)
"""Parts of a correction that are tried where it would crush a tet."""

UNTANGLINGS = 6
"""Rounds of carrying crushed tets along: each may crush others."""


def correct(
    flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats, stiffness: Stiffness
) -> Equilibrium | None:
    """Return the equilibrium near ``x`` (p, 3) to within :data:`CLOSE_MM`, None if it is far.

    ``stiffness`` is one nearby; the result has the last that served. Its residual is that before
    the last correction. Raises :class:`SolveError` (``solve.singular``).
    """
    accelerator = Accelerator()
    left = FACTORISATIONS
    # a projected stiffness is too stiff for its corrections to tell how far it still is
    bound = LONG_MM if stiffness.share == 0 else 0.0
    for number in range(LAGGED_CORRECTIONS):
        gradient = flesh.gradient(x, a)
        direction = stiffness.solve(-gradient) if bound else None
        if direction is None or not np.abs(direction).max() <= bound:
            if not left:
                return None
            left -= 1
            # flesh that needed some projection a moment ago hardly does without now
            stiffness = Stiffness(flesh, linear, x, a, max(stiffness.share - 1, 0))
            direction = stiffness.solve(-gradient)
            accelerator = Accelerator()
        length = float(np.abs(direction).max())
        step = accelerator.step(x[flesh.free].ravel(), direction)
        last = length <= CLOSE_MM
        moved = _moved(flesh, x, direction if last else step)
        if moved is None:
            return None
        if last:
            residual = float(np.linalg.norm(gradient)) / flesh.force_scale
            return Equilibrium(moved, moved, stiffness, residual, number)
        x, bound = moved, LAGGED_CONTRACTION * length
    return None


def _moved(flesh: Flesh, x: Floats, motion: Floats) -> Floats | None:
    """Return x (p, 3) with as much of the ``motion`` (size,) as crushes no tet."""
    for part in PARTS:
        moved = flesh.moved(x, part * motion)
        if flesh.narrowing(x, moved) >= NARROWEST:
            return moved
    return None


def untangled(flesh: Flesh, upright: Floats, moved: Floats) -> Floats | None:
    """Return ``moved`` (p, 3) with every tet that it crushes carried along whole; None if it fails.

    A linear prediction turns a few crushed tets beside the jaw inside out. Their free corners go
    with those that are held, or all four together, from where ``upright`` (p, 3) has them.
    """
    if flesh.narrowing(upright, moved) >= NARROWEST:
        return moved
    before = flesh.openings(upright)
    least = NARROWEST * np.minimum(before, BARRIER_START)
    for _ in range(UNTANGLINGS):
        crushed = flesh.openings(moved) < least
        if not crushed.any():
            return moved
        for tet in flesh.tets[crushed]:
            free = flesh.free_numbers[tet] >= 0
            leading = tet if free.all() else tet[~free]
            shift = (moved[leading] - upright[leading]).mean(axis=0)
            moved[tet[free]] = upright[tet[free]] + shift
    return None
