"""Quasi-static equilibrium: grad_x E(x; A, b) = 0 by Newton's method.

Near the solution the raw Hessian gives quadratic convergence. Far from it, and where it is not
positive definite, it is projected, no further than need be. A line search keeps the energy finite,
hence every tet upright.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from solver.errors import SolveError
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import Factor, LinearSolver, NotPositiveDefiniteError
from solver.surface import Floats

TOLERANCE = 1e-7
"""Residual |grad E| over the nodal forces at unit strain."""

STALLED = 1e-5
"""Residual at which a solve that can get no further still counts."""

MAX_ITERATIONS = 100
ARMIJO = 1e-4
SHORTEST_STEP = 2.0**-30
GROWTH = 4.0

SHARES = (0.0, 0.05, 0.15, 0.4, 1.0)
"""How far the Hessian is projected, one after the other, until it is positive definite."""

FAR = 0.3
"""Residual from which on a start is not worth trying with less than the whole projection."""

NARROWEST = 0.1
"""No step makes a tet's det F smaller than this part of what it was: a crushed tet opens slowly."""

REACH_MM = 0.3
"""A Newton step no longer than this is taken to end in the equilibrium."""

CORRECTIONS = 6


@dataclass(frozen=True)
class Equilibrium:
    """Vertices x (p, 3) with the factorised Hessian there, and what Newton's next step leads to.

    ``estimate`` (p, 3) is that step's end: the equilibrium to second order, x itself where that is
    solved. ``residual`` is |grad E| over the nodal forces at unit strain, ``iterations`` counts
    Newton steps, ``minimum`` tells that the Hessian was factorised as it is, so that it is positive
    definite (else ``factor`` is of a projected one).
    """

    x: Floats
    estimate: Floats
    factor: Factor
    residual: float
    iterations: int
    minimum: bool


def factorise(
    flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats, first: int = 0
) -> tuple[Factor, int]:
    """Factorise the Hessian at x, projected as far as need be; tell which of the SHARES it took.

    The first of :data:`SHARES` to be tried is number ``first``; 0 is the Hessian itself. Near
    buckling a small share is often enough, and keeps more of Newton's speed than all of it.
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
) -> Equilibrium:
    """Minimise E over the free vertices from ``x`` (p, 3), held vertices staying where they are.

    Raises :class:`SolveError`: ``solve.inverted`` if a tet is inverted at the start,
    ``solve.no_convergence`` if it stops at a residual above both ``tolerance`` and ``STALLED``.
    """
    found = _newton(flesh, linear, x, a, lambda now: now.residual <= tolerance, max_iterations)
    if found.residual > max(tolerance, STALLED):
        raise SolveError(
            "solve.no_convergence",
            f"equilibrium stopped at a residual of {found.residual:.1e} after "
            f"{found.iterations} steps",
            residual=found.residual,
        )
    return found


def approach(flesh: Flesh, linear: LinearSolver, x: Floats, a: Floats) -> Equilibrium:
    """Take Newton steps from ``x`` (p, 3) until the next one is shorter than :data:`REACH_MM`.

    Inside a fit that is near enough: ``estimate`` is what the fit compares with its target. Raises
    :class:`SolveError`: ``solve.inverted``, or ``solve.far`` after :data:`CORRECTIONS` steps.
    """

    def near(now: Equilibrium) -> bool:
        return float(np.abs(now.estimate - now.x).max()) <= REACH_MM

    found = _newton(flesh, linear, x, a, near, CORRECTIONS)
    if not near(found):
        raise SolveError("solve.far", "the equilibrium is too far for a few steps")
    return found


def _newton(
    flesh: Flesh,
    linear: LinearSolver,
    x: Floats,
    a: Floats,
    done: Callable[[Equilibrium], bool],
    max_iterations: int,
) -> Equilibrium:
    energy = flesh.energy(x, a)
    if not np.isfinite(energy):
        raise SolveError(
            "solve.inverted", f"{flesh.inverted(x)} tetrahedra are inverted before the first step"
        )
    share = -1
    for iteration in range(max_iterations + 1):
        gradient = flesh.gradient(x, a)
        residual = float(np.linalg.norm(gradient)) / flesh.force_scale
        first = _first_share(residual, share)
        factor, share = factorise(flesh, linear, x, a, first)
        direction = -factor.solve(gradient)
        estimate = x.copy()
        estimate[flesh.free] += direction.reshape(-1, 3)
        now = Equilibrium(x, estimate, factor, residual, iteration, share == 0)
        if iteration == max_iterations or done(now):
            break
        slope = float(gradient @ direction)
        step = _line_search(flesh, x, a, direction, energy, slope, share > 0)
        if step is None:
            break
        x, energy = step
    return now


def _first_share(residual: float, last: int) -> int:
    """Return the share to try first; ``last`` is what the step before took, -1 if there is none."""
    if residual <= TOLERANCE:
        return 0
    if last < 0:
        return len(SHARES) - 1 if residual > FAR else 0
    return max(last - 1, 0)


def _line_search(
    flesh: Flesh,
    x: Floats,
    a: Floats,
    direction: Floats,
    energy: float,
    slope: float,
    grow: bool,
) -> tuple[Floats, float] | None:
    """Halve the step until the energy falls enough (Armijo); None if it does not fall at all.

    With ``grow`` a full step that does is made longer while the energy goes on falling: where flesh
    buckles, at a saddle, the projected Hessian is too stiff.
    """

    def tried(step: float) -> tuple[Floats, float] | None:
        trial = x.copy()
        trial[flesh.free] += step * direction.reshape(-1, 3)
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
        step *= GROWTH
        longer = tried(step)
        if longer is None or longer[1] >= found[1]:
            break
        found = longer
    return found
