"""Quasi-static equilibrium, grad_x E(x; A, b) = 0: solved, predicted, or corrected from near by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solver.errors import SolveError
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import LinearSolver
from solver.mechanics.materials import BARRIER_START
from solver.mechanics.newton import Accelerator, Energy, Factorization, NewtonOptions, Search
from solver.surface import Floats


@dataclass(frozen=True)
class PredictorOptions:
    """Options of :func:`newton_predict`: how near to its equilibrium it goes."""

    reach_mm: float = 0.3  # a Newton step no longer than this is taken to end in the equilibrium
    corrections: int = 6  # Newton steps at most
    contraction: float = 0.3  # part of the step's length that the next chord step has at most
    # chord steps follow until the next is shorter than this, so many at most
    settled_mm: float = 0.02
    chords: int = 3


@dataclass(frozen=True)
class CorrectorOptions:
    """Limits at which :func:`correct` asks for a new Hessian, and at which it is near enough."""

    long_mm: float = 0.75  # a longer correction asks for a new Hessian
    close_mm: float = 0.2  # the end of a shorter one is good enough
    # so does one that is as many times as long as that before: accelerated ones may be longer
    contraction: float = 1.2
    corrections: int = 8
    factorizations: int = 5
    parts: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)  # tried where a tet would collapse
    min_jacobian_ratio: float = NewtonOptions.min_jacobian_ratio
    untanglings: int = 6  # rounds of carrying collapsed tets along: each may make others collapse


@dataclass(frozen=True)
class Equilibrium:
    """Vertices with the factorised Hessian there, and what Newton's next step leads to."""

    x: Floats  # (p, 3)
    estimate: Floats  # (p, 3) that step's end: x itself where it is solved
    # at x, or where it served last: about PredictorOptions.reach_mm away at most, same_mm where
    # solved; that of a correction is from further away
    factor: Factorization
    residual: float  # see Energy.residual
    iterations: int  # Newton steps

    @property
    def minimum(self) -> bool:
        """Tell whether the Hessian is positive definite as it is (else it has been projected)."""
        return self.factor.projection == 0


def solve_equilibrium(
    flesh: Flesh,
    linear: LinearSolver,
    x: Floats,
    a: Floats,
    *,
    tolerance: float = NewtonOptions.tolerance,
    max_iterations: int = NewtonOptions.factorizations,
    near: Factorization | None = None,
) -> Equilibrium:
    """Minimise E over the free vertices from ``x`` (p, 3), held vertices staying where they are.

    ``near`` is the Hessian of a state nearby, which is tried first. Raises :class:`SolveError`:
    ``solve.inverted`` if a tet is inverted at the start, ``solve.no_convergence`` if it stops at a
    residual above both ``tolerance`` and :attr:`NewtonOptions.stalled`.
    """
    options = NewtonOptions(tolerance=tolerance, factorizations=max_iterations)
    energy = Energy(flesh, linear, a)
    _check_orientation(energy, x)
    search = Search(energy, x, options, near)
    search.minimise()
    # NaN, too, is no equilibrium
    if not search.residual <= max(tolerance, options.stalled):
        steps = search.factorizations
        residual = search.residual
        message = f"equilibrium stopped at a residual of {residual:.1e} after {steps} steps"
        raise SolveError("solve.no_convergence", message, residual=residual)
    factor = search.factorization
    if factor is None or np.abs(factor.x - search.x).max() > options.same_mm:
        factor = Factorization(flesh, linear, search.x, a)
    return Equilibrium(search.x, search.x, factor, search.residual, search.factorizations)


def newton_predict(
    flesh: Flesh,
    linear: LinearSolver,
    x: Floats,
    a: Floats,
    options: PredictorOptions = PredictorOptions(),
) -> Equilibrium:
    """Take Newton steps from ``x`` (p, 3) until the next one is short, then some chord steps.

    They go on where the Hessian is not positive definite: beyond a fold a step is short, too, but
    leads to no equilibrium. A rough prediction, whose ``settled_mm`` is its reach, may end there.
    Raises :class:`SolveError`: ``solve.inverted``, or ``solve.far`` after so many steps.
    """
    energy = Energy(flesh, linear, a)
    _check_orientation(energy, x)
    search = Search(energy, x, NewtonOptions())
    rough = options.settled_mm >= options.reach_mm
    for iteration in range(options.corrections + 1):
        direction = search.direction()
        if search.factorization and np.abs(direction).max() <= options.reach_mm:
            now = search.x
            estimate = flesh.add_motion(search.x, direction)
            found = Equilibrium(now, estimate, search.factorization, search.residual, iteration)
            if rough or found.minimum:
                return _polish(energy, found, options)
        step = search.line_search(direction)
        if step is None:
            break
        search.go_to(step[0])
    raise SolveError("solve.far", "the equilibrium is too far for a few steps")


def _check_orientation(energy: Energy, x: Floats) -> None:
    if not np.isfinite(energy.value(x)):
        flesh = energy.flesh
        for term in flesh.terms[1:]:
            if not np.isfinite(term.energy(flesh.rest, energy.a)):
                message = f"the energy of {type(term).__name__} is not finite, not even at rest"
                raise SolveError("solve.not_finite", message)
        count = energy.flesh.count_inverted(x)
        raise SolveError("solve.inverted", f"{count} tetrahedra are inverted before the first step")


def _polish(energy: Energy, now: Equilibrium, options: PredictorOptions) -> Equilibrium:
    """Follow an estimate by chord steps that get shorter."""
    flesh = energy.flesh
    for _ in range(options.chords):
        length = np.abs(now.estimate - now.x).max()
        ratio = flesh.min_jacobian_ratio(now.x, now.estimate)
        if length <= options.settled_mm or ratio < NewtonOptions.min_jacobian_ratio:
            break
        x = now.estimate
        gradient = energy.gradient(now.estimate)
        direction = now.factor.solve(-gradient)
        if np.abs(direction).max() > options.contraction * length:
            break
        estimate = flesh.add_motion(x, direction)
        residual = energy.residual(gradient)
        now = replace(now, x=x, estimate=estimate, residual=residual)
    return now


def correct(
    flesh: Flesh,
    linear: LinearSolver,
    x: Floats,
    a: Floats,
    factor: Factorization,
    options: CorrectorOptions = CorrectorOptions(),
) -> Equilibrium | None:
    """Return the equilibrium near ``x`` (p, 3) to within ``close_mm``, None if it is far.

    Corrections with an old Hessian go on while they get shorter, with Anderson's acceleration.
    ``factor`` is that of a state nearby; the result has the last that served, and the residual
    before the last correction. Raises :class:`SolveError` (``solve.singular``).
    """
    energy = Energy(flesh, linear, a)
    accelerator = Accelerator()
    left = options.factorizations
    # a projected Hessian is too stiff for its corrections to tell how far it still is
    bound = options.long_mm if factor.projection == 0 else 0.0
    for number in range(options.corrections):
        gradient = energy.gradient(x)
        direction = factor.solve(-gradient) if bound else None
        if direction is None or not np.abs(direction).max() <= bound:
            if not left:
                return None
            left -= 1
            # flesh that needed some projection a moment ago hardly does without now
            factor = energy.factorization(x, max(factor.projection - 1, 0))
            direction = factor.solve(-gradient)
            accelerator = Accelerator()
        length = float(np.abs(direction).max())
        step = accelerator.step(x[flesh.free].ravel(), direction)
        last = length <= options.close_mm
        moved = _move(flesh, x, direction if last else step, options)
        if moved is None:
            return None
        if last:
            return Equilibrium(moved, moved, factor, energy.residual(gradient), number)
        x = moved
        bound = options.contraction * length
    return None


def _move(flesh: Flesh, x: Floats, motion: Floats, options: CorrectorOptions) -> Floats | None:
    """Return x (p, 3) with as much of the ``motion`` (size,) as makes no tet collapse."""
    for part in options.parts:
        moved = flesh.add_motion(x, part * motion)
        if flesh.min_jacobian_ratio(x, moved) >= options.min_jacobian_ratio:
            return moved
    return None


def untangle(
    flesh: Flesh, start: Floats, moved: Floats, options: CorrectorOptions = CorrectorOptions()
) -> Floats | None:
    """Return ``moved`` (p, 3), every tet that collapses carried along whole; None if it fails.

    A linear prediction turns a few tets beside the jaw inside out. Their free corners go with those
    that are held, or all four together, from ``start`` (p, 3), in which no tet is inverted.
    """
    if flesh.min_jacobian_ratio(start, moved) >= options.min_jacobian_ratio:
        return moved
    moved = moved.copy()
    least = options.min_jacobian_ratio * np.minimum(flesh.jacobians(start), BARRIER_START)
    for _ in range(options.untanglings):
        collapsed = flesh.jacobians(moved) < least
        if not collapsed.any():
            return moved
        for tet in flesh.tets[collapsed]:
            free = flesh.free_numbers[tet] >= 0
            leading = tet if free.all() else tet[~free]
            shift = (moved[leading] - start[leading]).mean(axis=0)
            moved[tet[free]] = start[tet[free]] + shift
    return None
