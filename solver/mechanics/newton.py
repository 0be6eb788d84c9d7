"""Newton's method for the least energy of flesh and of what it touches.

Where the Hessian is not positive definite, or far from the solution, it is projected, no further
than need be. A line search keeps the energy finite, hence every tet positively oriented. Where a
Hessian from nearby still serves, its chord steps do instead, with Anderson's acceleration: one
costs a fraction of a new factorization.

Equilibria (:mod:`solver.mechanics.equilibrium`) and moments of a simulation
(:mod:`solver.simulation`) are found by the same :class:`Search` with other options.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import SolveError
from solver.mechanics.boundary import Boundary, Potential, curvature
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import Factor, GrowingSolver, LinearSolver, NotPositiveDefiniteError
from solver.surface import Floats


@dataclass(frozen=True)
class NewtonOptions:
    """Options of a :class:`Search`. Residuals are |grad E| over the nodal forces at unit strain."""

    tolerance: float = 1e-7  # residual that ends a search
    stalled: float = 1e-5  # residual at which one that gets no further still counts
    factorizations: int = 100  # of a search at most
    # a search ends after so many steps in turn that are shorter, root mean square over the
    # vertices, where the residual is below "quiet": pressed lips slide on for long
    settled_mm: float = 0.0
    settled_steps: int = 2
    quiet: float = 3e-4

    same_mm: float = 1e-3  # motion over which a factorised Hessian counts as the one at the end

    armijo: float = 1e-4  # part of the predicted decrease that a step has to make
    shortest_step: float = 2.0**-30  # step length below which a line search gives up
    growth: float = 4.0  # a step of a projected Hessian, too stiff where flesh buckles, may grow so
    min_jacobian_ratio: float = 0.1  # of a step: a collapsed tet opens slowly
    margin: float = 0.9  # part of the way to the next collision that a step goes

    # of the Hessian, in turn until it is positive definite: near buckling a small one is often
    # enough, and keeps more of Newton's speed
    projections: tuple[float, ...] = (0.0, 0.05, 0.15, 0.4, 1.0)
    collapsed: float = 1e-3  # det F below which a tet is too stiff for its neighbours
    quadratic: float = 1e-7  # residual below which the Hessian is tried as it is, contact's too
    far: float = 0.3  # residual above which a search begins with the whole projection

    # part of the residual that a chord step leaves at most: it costs a fifth to an eighth of a
    # factorization, and most simulated expressions need none
    chord_contraction: float = 0.7
    # part that a Newton step leaves at most for its Hessian to serve for chord steps
    reuse_contraction: float = math.inf


class Accelerator:
    """Anderson's acceleration of corrections with an old Hessian (Walker and Ni 2011).

    The corrections (size,) of ``depth`` points tell in which few modes the Hessian is wrong.
    """

    def __init__(self, depth: int = 8) -> None:
        self._depth = depth
        self._points: list[Floats] = []
        self._corrections: list[Floats] = []

    def step(self, point: Floats, correction: Floats) -> Floats:
        """Return the step from ``point``, the ``correction`` there itself if it is the first."""
        self._points = [*self._points[-self._depth :], point]
        self._corrections = [*self._corrections[-self._depth :], correction]
        if len(self._points) < 2:
            return correction
        changes = np.diff(self._corrections, axis=0).T
        # they get shorter by orders of magnitude: all count alike
        scale = np.linalg.norm(changes, axis=0)
        if not (np.isfinite(scale).all() and scale.all()):
            return correction
        weights = np.linalg.lstsq(changes / scale, correction, rcond=1e-6)[0] / scale
        return np.asarray(correction - (np.diff(self._points, axis=0).T + changes) @ weights)


class Factorization(Factor):
    """The Hessian at x (p, 3) with controls ``a``, factorised when first asked for.

    It is projected as far as need be, from number ``first`` of the options' ``projections`` on.
    Its members raise :class:`SolveError`: ``solve.crushed`` where a tet has next to no volume left,
    else ``solve.singular``.
    """

    def __init__(
        self,
        flesh: Flesh,
        linear: LinearSolver,
        x: Floats,
        a: Floats,
        first: int = 0,
        options: NewtonOptions = NewtonOptions(),
    ) -> None:
        self.x = x
        self._flesh = flesh
        self._linear = linear
        self._a = a
        self._first = first
        self._options = options

    @override
    def solve(self, B: Floats) -> Floats:
        return self._factor_and_projection[0].solve(B)

    @property
    def projection(self) -> int:
        """Return the number of the projection that it took; 0 is the Hessian itself."""
        return self._factor_and_projection[1]

    @cached_property
    def _factor_and_projection(self) -> tuple[Factor, int]:
        flesh = self._flesh
        projections = self._options.projections
        for number in range(self._first, len(projections)):
            matrix = flesh.hessian(self.x, self._a, project=projections[number])
            if number:
                # a projected element may be semi-definite: a trace of it all keeps the sum definite
                diagonal = flesh.block_sum.diagonal
                mean = matrix.data[diagonal].mean()
                matrix.data[diagonal] += 1e-6 * projections[number] * mean
            try:
                return self._linear.factor(matrix.data), number
            except NotPositiveDefiniteError:
                pass
        jacobians = flesh.jacobians(self.x)
        tet = int(jacobians.argmin())
        if jacobians[tet] < self._options.collapsed:
            place = np.round(flesh.rest[flesh.tets[tet]].mean(axis=0)).tolist()
            message = (
                f"elements near {place} have collapsed: the constraints around them have closed"
            )
            raise SolveError("solve.crushed", message, tet=tet, place_mm=place)
        message = "the flesh's Hessian is singular: a part of it is held by nothing"
        raise SolveError("solve.singular", message)


class Energy:
    """Energy of a flesh with controls ``a``, and of ``potentials``, for a search to minimise.

    ``linear`` solves for the flesh's pattern; with potentials it has to be a
    :class:`~solver.mechanics.linear.GrowingSolver`. Rigid parts stay where potentials have them,
    but are on their way to ``goal`` where one is given.
    """

    def __init__(
        self,
        flesh: Flesh,
        linear: LinearSolver | GrowingSolver,
        a: Floats,
        potentials: Sequence[Potential] = (),
        goal: Boundary | None = None,
    ) -> None:
        self.flesh = flesh
        self.a = a
        self._linear = linear
        self._potentials = potentials
        self._goal = goal

    @property
    def touches(self) -> bool:
        """Tell whether there is something to touch."""
        return bool(self._potentials)

    def value(self, x: Floats) -> float:
        """Return the energy of x (p, 3)."""
        return self.flesh.energy(x, self.a) + sum(each.value(x) for each in self._potentials)

    def gradient(self, x: Floats) -> Floats:
        """Return its derivative by the free coordinates, (size,)."""
        gradient = self.flesh.gradient(x, self.a)
        for each in self._potentials:
            gradient += each.gradient(x)[self.flesh.free].ravel()
        return gradient

    def residual(self, gradient: Floats) -> float:
        """Return |grad E| over the nodal forces at unit strain."""
        return float(np.linalg.norm(gradient)) / self.flesh.force_scale

    def factorization(self, x: Floats, first: int) -> Factorization:
        """Return the Hessian at x, to be projected from number ``first`` on."""
        return self._factorization(x, first, self.contact_hessian(x))

    def exact_factorization(self, x: Floats) -> Factorization | None:
        """Return the Hessian at x with the potentials' as it is, None if that is indefinite."""
        found = self._factorization(x, 0, curvature(self._potentials, x))
        try:
            return found if found.projection == 0 else None
        except SolveError:
            return None

    def _factorization(self, x: Floats, first: int, contact: sp.csr_array) -> Factorization:
        linear = self._linear
        if isinstance(linear, GrowingSolver):
            linear = linear.plus(self.flesh.free_block(contact))
        return Factorization(self.flesh, linear, x, self.a, first)

    def contact_hessian(self, x: Floats) -> sp.csr_array:
        """Return the sum of the potentials' Hessians (3 p, 3 p)."""
        return sum((each.hessian(x) for each in self._potentials), sp.csr_array((x.size, x.size)))

    def max_step(self, x: Floats, y: Floats, options: NewtonOptions) -> float:
        """Return the part of the way x -> y that crosses nothing and makes no tet collapse."""
        part = 1.0
        goal = self._goal
        if goal is not None:
            part = min((each.max_step(x, y, goal) for each in self._potentials), default=1.0)
            part = 1.0 if part >= 1.0 else options.margin * part
        while part > options.shortest_step:
            if self.flesh.min_jacobian_ratio(x, x + part * (y - x)) >= options.min_jacobian_ratio:
                break
            part *= 0.5
        return part


class _Step(NamedTuple):
    """End of a step: x (p, 3), the gradient (size,) there, and the part of it that was taken."""

    x: Floats
    gradient: Floats
    part: float


class Search:
    """A search for the least energy from x (p, 3): where it is, and the last Hessian that serves.

    ``factorization`` is of a state nearby, ``projection`` the number that the Hessian before took,
    -1 if there was none.
    """

    def __init__(
        self,
        energy: Energy,
        x: Floats,
        options: NewtonOptions,
        factorization: Factorization | None = None,
        projection: int = -1,
    ) -> None:
        self._energy = energy
        self._options = options
        self._accelerator = Accelerator()
        self.x = x
        self.gradient = energy.gradient(x)
        self.factorization = factorization
        self.projection = projection
        self.steps = self.factorizations = 0

    @property
    def residual(self) -> float:
        """Return the residual."""
        return self._energy.residual(self.gradient)

    def minimise(self) -> None:
        """Go on until the search ends: at its tolerance, settled, or where no step leads down.

        An equilibrium that is unstable but perfectly symmetric is one to chord steps, too: the
        slightest asymmetry, 1e-4 mm of a column, leads away from it.
        """
        options = self._options
        settled = 0
        while self.residual > options.tolerance and settled < options.settled_steps:
            step = self._chord()
            if step is None:
                if self.factorizations == options.factorizations:
                    break
                step = self._newton()
                if step is None:
                    break
            length = np.sqrt(((step.x - self.x) ** 2).sum(axis=1).mean())
            self.x = step.x
            self.gradient = step.gradient
            self.steps += 1
            # a step that something is in the way of is short, and says nothing
            quiet = step.part == 1.0 and self.residual <= options.quiet
            settled = settled + 1 if quiet and length < options.settled_mm else 0

    def go_to(self, x: Floats) -> None:
        """Go on from x (p, 3)."""
        self.x, self.gradient = x, self._energy.gradient(x)

    def direction(self) -> Floats:
        """Factorise the Hessian here and return Newton's step (size,)."""
        found = None
        if self._energy.touches and self.residual <= self._options.quadratic:
            # projected contact converges linearly
            found = self._energy.exact_factorization(self.x)
        if found is None:
            found = self._energy.factorization(self.x, self._first_projection())
        self.factorization = found
        self.projection = self.factorization.projection
        self.factorizations += 1
        return self.factorization.solve(-self.gradient)

    def line_search(self, direction: Floats) -> tuple[Floats, float] | None:
        """Halve the step until the energy falls enough (Armijo); None if it does not fall at all.

        Where the Hessian was projected a full step is made longer while the energy goes on falling:
        where flesh buckles, at a saddle, it is too stiff. Returns the end and the step's length, 1
        being the whole ``direction``.
        """
        options = self._options
        flesh = self._energy.flesh
        x = self.x
        value = self._energy.value(x)
        slope = float(self.gradient @ direction)

        def try_step(length: float) -> tuple[Floats, float] | None:
            trial = flesh.add_motion(x, length * direction)
            reached = self._energy.value(trial)
            # rounding decides once the predicted decrease is below the energy's last digits
            enough = reached <= value + options.armijo * length * slope + 1e-13 * abs(value)
            return (trial, reached) if enough else None

        length = self._energy.max_step(x, flesh.add_motion(x, direction), options)
        found = None
        while found is None and length > options.shortest_step:
            found = try_step(length)
            length = length if found else 0.5 * length
        if found is None:
            return None
        while self.projection > 0 and length >= 1.0 and options.growth > 1.0:
            trial = flesh.add_motion(x, options.growth * length * direction)
            if flesh.min_jacobian_ratio(x, trial) < options.min_jacobian_ratio:
                break
            longer = try_step(options.growth * length)
            if longer is None or longer[1] >= found[1]:
                break
            found = longer
            length = options.growth * length
        return found[0], length

    def _chord(self) -> _Step | None:
        """Return an accelerated step with the last Hessian, None if it is of no use."""
        if self.factorization is None:
            return None
        energy = self._energy
        flesh = self._energy.flesh
        correction = self.factorization.solve(-self.gradient)
        point = self.x[flesh.free].ravel()
        y = flesh.add_motion(self.x, self._accelerator.step(point, correction))
        if energy.max_step(self.x, y, self._options) < 1.0:
            return None
        after = energy.gradient(y)
        # NaN is no progress either
        return _Step(y, after, 1.0) if self._gains(after, self._options.chord_contraction) else None

    def _newton(self) -> _Step | None:
        """Return the end of a Newton step, None if the energy does not fall along it."""
        self._accelerator = Accelerator()
        found = self.line_search(self.direction())
        if found is None:
            return None
        y, part = found
        after = self._energy.gradient(y)
        # what was projected, or led only part of the way, is no good a second time
        serves = self.projection == 0 and part == 1.0
        if not (serves and self._gains(after, self._options.reuse_contraction)):
            self.factorization = None
        return _Step(y, after, part)

    def _gains(self, after: Floats, contraction: float) -> bool:
        return bool(np.linalg.norm(after) <= contraction * np.linalg.norm(self.gradient))

    def _first_projection(self) -> int:
        if self.residual <= self._options.quadratic:
            return 0
        if self.projection < 0:
            return len(self._options.projections) - 1 if self.residual > self._options.far else 0
        return max(self.projection - 1, 0)
