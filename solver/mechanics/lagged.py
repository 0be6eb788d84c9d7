"""Equilibrium near a known one: Newton's method with a stiffness from somewhere near.

A factorisation costs as much as several corrections with an old one. So these go on while they get
shorter, with Anderson's acceleration: it finds the few modes in which the old stiffness is wrong.
"""

from __future__ import annotations

import numpy as np

from solver.mechanics.anderson import Accelerator
from solver.mechanics.equilibrium import NARROWEST, Equilibrium, Stiffness
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import LinearSolver
from solver.mechanics.material import BARRIER_START
from solver.surface import Floats

LONG_MM, CLOSE_MM = 0.75, 0.2
"""A longer correction asks for a new stiffness; the end of a shorter one is good enough."""

CONTRACTION = 1.2
"""A correction that is as many times as long as the one before asks for a new stiffness too: an
accelerated one may be longer now and then."""

CORRECTIONS = 8
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
    for number in range(CORRECTIONS):
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
        x, bound = moved, CONTRACTION * length
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
