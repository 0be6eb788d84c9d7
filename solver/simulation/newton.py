"""Newton's method for flesh and what it touches, while bones and objects are on their way.

Energies with barriers are infinite where things cross, so that neither the flesh nor what is rigid
can jump to its place. Both advance together: a step is Newton's, with the pull of what the rigid
parts will do, and goes as far as nothing crosses. So flesh is pushed before it is reached. Once all
is where it belongs the energy falls to its minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from solver.errors import SolveError
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import GrowingSolver
from solver.mechanics.newton import Energy, Factorization, NewtonOptions, Search
from solver.mechanics.potential import Boundary, Potential
from solver.surface import Floats

MOMENT = NewtonOptions(
    tolerance=1e-5,
    stalled=1e-3,
    factorizations=30,  # a search that needs more had better go a shorter way
    settled_mm=0.005,
    shortest_step=2.0**-24,
    growth=1.0,
    far=np.inf,
    chord_contraction=0.5,
    reuse_contraction=0.5,
)


@dataclass(frozen=True)
class AdvanceOptions:
    """Options of the boundary's way to its goal."""

    steps: int = 40  # at most
    same: float = 1e-9  # difference of two places, in mm, that is rounding
    jammed: float = 1e-3  # part of the way that a step gains at least ...
    jams: int = 5  # ... or it may gain less so often


@dataclass(frozen=True)
class Minimum:
    """Vertices x (p, 3) of least energy, the residual there, and the steps that led to it."""

    x: Floats
    residual: float
    iterations: int


class Newton:
    """Minimises the energy of ``flesh`` and ``potentials``; what it factorised last serves again.

    A search ends as ``options`` say: at a residual, or after steps that are short, as lips that are
    pressed together slide on by hundredths of a millimetre for long. ``linear`` names the linear
    solver.
    """

    def __init__(
        self,
        flesh: Flesh,
        potentials: Sequence[Potential],
        *,
        options: NewtonOptions = MOMENT,
        linear: str | None,
    ) -> None:
        self._flesh = flesh
        self._potentials = potentials
        self._options = options
        self._solver = GrowingSolver(flesh.hessian(flesh.rest, flesh.passive()), linear)
        self.forget()

    def forget(self) -> None:
        """Forget what was factorised: what comes next is far from it."""
        self._factor: Factorization | None = None
        self._projection = -1

    def minimise(
        self,
        x: Floats,
        a: Floats,
        now: Boundary,
        goal: Boundary,
        factorizations: int = MOMENT.factorizations,
    ) -> Minimum:
        """Go from x (p, 3) at ``now`` to the least energy at ``goal`` with activations a (n, 6).

        The search ends after so many ``factorizations``. Raises :class:`SolveError`:
        ``simulate.jammed`` where the boundary gets no further, ``simulate.diverged`` where the
        energy comes to no minimum.
        """
        energy = Energy(self._flesh, self._solver, a, self._potentials, goal)
        x, advances = self._advance(energy, x, now, goal)
        options = replace(self._options, factorizations=factorizations)
        search = Search(energy, x, options, self._factor, self._projection)
        try:
            search.minimise()
        finally:
            self._factor, self._projection = search.factorization, search.projection
        # NaN, too, is no minimum
        if not search.residual <= max(options.stalled, options.tolerance):
            raise SolveError(
                "simulate.diverged",
                f"the flesh found no rest: a residual of {search.residual:.1e}"
                f" after {search.steps} steps",
                residual=search.residual,
            )
        return Minimum(search.x, search.residual, advances + search.steps)

    def _advance(
        self,
        energy: Energy,
        x: Floats,
        now: Boundary,
        goal: Boundary,
        options: AdvanceOptions = AdvanceOptions(),
    ) -> tuple[Floats, int]:
        """Return x (p, 3) with the boundary at its ``goal``, and the steps that it took."""
        self._place(now)
        held = self._flesh.held
        old, steps, jams = self._factor is not None, 0, 0
        while not _same(now, goal, options.same):
            factor = self._factor or self._factorize(energy, x)
            motion = np.zeros_like(x)
            motion[held] = goal.held - x[held]
            force = energy.gradient(x) + self._pull(energy, x, motion, goal)
            y = self._flesh.moved(x + motion, -factor.solve(force))
            part = energy.longest(x, y, self._options)
            if part < 1.0 and old:
                # an old factor knows nothing of what is in the way now
                self._factor, old = None, False
                continue
            steps += 1
            jams += part < options.jammed
            if jams == options.jams or steps == options.steps:
                raise SolveError("simulate.jammed", "the jaw or an object can go no further")
            now = goal if part == 1.0 else now.toward(goal, part)
            x = y if part == 1.0 else x + part * (y - x)
            self._place(now)
            if part < 1.0:
                self._factor = None
        return x, steps

    def _factorize(self, energy: Energy, x: Floats) -> Factorization:
        """Factorise the Hessian at x, projected as far as need be."""
        self._factor = energy.factorization(x, max(self._projection - 1, 0))
        self._projection = self._factor.projection
        return self._factor

    def _pull(self, energy: Energy, x: Floats, motion: Floats, goal: Boundary) -> Floats:
        """Return how the gradient changes as held vertices move by ``motion`` and all else goes."""
        rigid = (energy.contact_hessian(x) @ motion.ravel()).reshape(-1, 3)
        for each in self._potentials:
            rigid += each.pull(x, goal)
        flesh = self._flesh.coupling(x, energy.a, motion[:, :, None])[:, 0]
        return np.asarray(flesh + rigid[self._flesh.free].ravel())

    def _place(self, boundary: Boundary) -> None:
        for each in self._potentials:
            each.place(boundary)


def _same(now: Boundary, goal: Boundary, rounding: float) -> bool:
    mine, theirs = (now.held, now.jaw, *now.objects), (goal.held, goal.jaw, *goal.objects)
    return all(
        np.allclose(a, b, rtol=0.0, atol=rounding) for a, b in zip(mine, theirs, strict=True)
    )
