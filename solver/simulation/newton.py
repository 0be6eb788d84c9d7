"""Newton's method for flesh and what it touches, while bones and objects are on their way.

Energies with barriers are infinite where things cross, so that neither the flesh nor what is rigid
can jump to its place. Both advance together: a step is Newton's, with the pull of what the rigid
parts will do, and goes as far as nothing crosses. So flesh is pushed before it is reached. Once all
is where it belongs the energy falls to its minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.mechanics.equilibrium import ARMIJO, NARROWEST, Accelerator, factorise
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import Factor, GrowingSolver
from solver.mechanics.potential import Boundary, Potential
from solver.surface import Floats

FACTORISATIONS = 30
"""Of a search; one that needs more had better go a shorter way."""
STALLED = 1e-3
"""Residual at which a search that can get no further still counts."""

SAFE = 0.9
"""Part of the way to the next collision that a step goes."""

ADVANCES = 40
SAME = 1e-9
"""Difference of two places, in mm, that is rounding."""
SHORTEST_STEP = 2.0**-24
JAMMED, JAMS = 1e-3, 5
"""Part of the way that a step gains at least, and how often it may gain less."""

SETTLED_STEPS, QUIET = 2, 3e-4
"""Steps in turn, each shorter than what counts as settled, that end a search, and the residual
above which nothing is settled."""

COASTING = 0.5
"""Part of the residual that a step with an old factor leaves at most: else a new one is made."""


_Step = tuple[Floats, Floats, float]
"""Where a step ends, x (p, 3), the gradient (size,) there, and the part of it that was taken."""


@dataclass(frozen=True)
class Minimum:
    """Vertices x (p, 3) of least energy, the residual there, and the steps that led to it."""

    x: Floats
    residual: float
    iterations: int


class Newton:
    """Minimises the energy of ``flesh`` and ``potentials``; what it factorised last serves again.

    A search ends at a residual |grad E| of ``tolerance`` over the nodal forces at unit strain, or
    after steps shorter than ``settled_mm``, root mean square over the vertices: lips that are
    pressed together slide on by hundredths of a millimetre for long. ``linear`` names the linear
    solver.
    """

    def __init__(
        self,
        flesh: Flesh,
        potentials: Sequence[Potential],
        *,
        tolerance: float,
        settled_mm: float,
        linear: str | None,
    ) -> None:
        self._flesh = flesh
        self._potentials = potentials
        self._tolerance = tolerance
        self._settled_mm = settled_mm
        self._solver = GrowingSolver(flesh.hessian(flesh.rest, flesh.passive()), linear)
        coordinates = (3 * flesh.free[:, None] + np.arange(3)).ravel()
        self._numbers = np.full(flesh.rest.size, -1)
        self._numbers[coordinates] = np.arange(flesh.size)
        self._factor: Factor | None = None
        self._share = 0

    def forget(self) -> None:
        """Forget what was factorised: what comes next is far from it."""
        self._factor = None
        self._share = 0

    def minimise(
        self,
        x: Floats,
        a: Floats,
        now: Boundary,
        goal: Boundary,
        factorisations: int = FACTORISATIONS,
    ) -> Minimum:
        """Go from x (p, 3) at ``now`` to the least energy at ``goal`` with activations a (n, 6).

        The search ends after so many ``factorisations``. Raises :class:`SolveError`:
        ``simulate.jammed`` where the boundary gets no further, ``simulate.diverged`` where the
        energy comes to no minimum.
        """
        x, advances = self._advance(x, a, now, goal)
        gradient = self._gradient(x, a)
        accelerator = Accelerator()
        settled = steps = 0
        while self._residual(gradient) > self._tolerance and settled < SETTLED_STEPS:
            found = self._chord(x, a, goal, gradient, accelerator)
            if found is None:
                if factorisations == 0:
                    break
                factorisations -= 1
                accelerator = Accelerator()
                found = self._newton(x, a, goal, gradient)
                if found is None:
                    break
            y, gradient, part = found
            length = np.sqrt(((y - x) ** 2).sum(axis=1).mean())
            # a step that something is in the way of is short, and says nothing
            quiet = part == 1.0 and self._residual(gradient) <= QUIET
            settled = settled + 1 if quiet and length <= self._settled_mm else 0
            steps += 1
            x = y
        residual = self._residual(gradient)
        # NaN, too, is no minimum
        if not residual <= max(STALLED, self._tolerance):
            raise SolveError(
                "simulate.diverged",
                f"the flesh found no rest: a residual of {residual:.1e} after {steps} steps",
                residual=residual,
            )
        return Minimum(x, residual, advances + steps)

    def _advance(self, x: Floats, a: Floats, now: Boundary, goal: Boundary) -> tuple[Floats, int]:
        """Return x (p, 3) with the boundary at its ``goal``, and the steps that it took."""
        self._place(now)
        held = self._flesh.held
        old, steps, jams = self._factor is not None, 0, 0
        while not _same(now, goal):
            factor = self._factor or self._factorised(x, a)
            motion = np.zeros_like(x)
            motion[held] = goal.held - x[held]
            force = self._gradient(x, a) + self._pull(x, a, motion, goal)
            y = self._flesh.moved(x + motion, -factor.solve(force))
            part = self._feasible(x, y, goal)
            if part < 1.0 and old:
                # an old factor knows nothing of what is in the way now
                self._factor, old = None, False
                continue
            steps += 1
            jams += part < JAMMED
            if jams == JAMS or steps == ADVANCES:
                raise SolveError("simulate.jammed", "the jaw or an object can go no further")
            now = goal if part == 1.0 else now.toward(goal, part)
            x = y if part == 1.0 else x + part * (y - x)
            self._place(now)
            if part < 1.0:
                self._factor = None
        return x, steps

    def _chord(
        self, x: Floats, a: Floats, goal: Boundary, gradient: Floats, accelerator: Accelerator
    ) -> _Step | None:
        """Step with the last factor; return None if that is no use."""
        if self._factor is None:
            return None
        correction = self._factor.solve(-gradient)
        y = self._flesh.moved(x, accelerator.step(x[self._flesh.free].ravel(), correction))
        if self._feasible(x, y, goal) < 1.0:
            return None
        after = self._gradient(y, a)
        # NaN is no progress either
        if not np.linalg.norm(after) <= COASTING * np.linalg.norm(gradient):
            return None
        return y, after, 1.0

    def _newton(self, x: Floats, a: Floats, goal: Boundary, gradient: Floats) -> _Step | None:
        """Take a Newton step; return None if the energy does not fall along it."""
        direction = self._factorised(x, a).solve(-gradient)
        energy, slope = self._energy(x, a), float(gradient @ direction)
        part = self._feasible(x, self._flesh.moved(x, direction), goal)
        while part > SHORTEST_STEP:
            y = self._flesh.moved(x, part * direction)
            # rounding decides once the predicted decrease is below the energy's last digits
            if self._energy(y, a) <= energy + ARMIJO * part * slope + 1e-13 * abs(energy):
                after = self._gradient(y, a)
                # what was projected, or led only part of the way, is no good a second time
                gained = np.linalg.norm(after) <= COASTING * np.linalg.norm(gradient)
                if self._share or part < 1.0 or not gained:
                    self._factor = None
                return y, after, part
            part *= 0.5
        return None

    def _feasible(self, x: Floats, y: Floats, goal: Boundary) -> float:
        """Return the part of the way from x to y, the boundary going to ``goal``, that may be."""
        part = min((each.longest(x, y, goal) for each in self._potentials), default=1.0)
        part = 1.0 if part >= 1.0 else SAFE * part
        while part > SHORTEST_STEP and self._flesh.narrowing(x, x + part * (y - x)) < NARROWEST:
            part *= 0.5
        return part

    def _factorised(self, x: Floats, a: Floats) -> Factor:
        """Factorise the Hessian at x, projected as far as need be."""
        linear = self._solver.plus(self._of_free(self._contact(x)))
        first = max(self._share - 1, 0)
        self._factor, self._share = factorise(self._flesh, linear, x, a, first)
        return self._factor

    def _contact(self, x: Floats) -> sp.csr_array:
        """Return the sum of the potentials' Hessians (3 p, 3 p)."""
        total = sp.csr_array((x.size, x.size))
        for each in self._potentials:
            total = total + each.hessian(x)
        return total

    def _of_free(self, matrix: sp.csr_array) -> sp.csr_array:
        """Return the part of a matrix (3 p, 3 p) that belongs to free coordinates."""
        entries = matrix.tocoo()
        row, column = self._numbers[entries.row], self._numbers[entries.col]
        kept = (row >= 0) & (column >= 0)
        return sp.csr_array(
            (entries.data[kept], (row[kept], column[kept])), shape=(self._flesh.size,) * 2
        )

    def _pull(self, x: Floats, a: Floats, motion: Floats, goal: Boundary) -> Floats:
        """Return how the gradient changes as held vertices move by ``motion`` and all else goes."""
        rigid = (self._contact(x) @ motion.ravel()).reshape(-1, 3)
        for each in self._potentials:
            rigid += each.pull(x, goal)
        return self._flesh.coupling(x, a, motion[:, :, None])[:, 0] + self._free(rigid)

    def _gradient(self, x: Floats, a: Floats) -> Floats:
        gradient = self._flesh.gradient(x, a)
        for each in self._potentials:
            gradient += self._free(each.gradient(x))
        return gradient

    def _energy(self, x: Floats, a: Floats) -> float:
        return self._flesh.energy(x, a) + sum(each.value(x) for each in self._potentials)

    def _residual(self, gradient: Floats) -> float:
        return float(np.linalg.norm(gradient)) / self._flesh.force_scale

    def _free(self, per_vertex: Floats) -> Floats:
        return np.asarray(per_vertex[self._flesh.free].ravel())

    def _place(self, boundary: Boundary) -> None:
        for each in self._potentials:
            each.place(boundary)


def _same(now: Boundary, goal: Boundary) -> bool:
    mine, theirs = (now.held, now.jaw, *now.objects), (goal.held, goal.jaw, *goal.objects)
    return all(np.allclose(a, b, rtol=0.0, atol=SAME) for a, b in zip(mine, theirs, strict=True))
