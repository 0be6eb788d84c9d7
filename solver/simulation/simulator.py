"""A face in motion: from where it is to where a moment's activations, jaw and forces take it.

Every unknown is in the head's frame, whatever the head does: see :mod:`solver.simulation.inertia`.
A step that finds no end is halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.mechanics.linear import fastest
from solver.mechanics.potential import Boundary, Potential
from solver.similarity import Similarity
from solver.simulation.forces import Force
from solver.simulation.inertia import Drive, Inertia, Motion, lumped_masses
from solver.simulation.newton import MOMENT, Minimum, Newton
from solver.surface import Floats


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulation: how a step is cut, and how the first pose is reached."""

    smallest_part: float = 2.0**-6  # of a step: it is not cut further
    rise_seconds: float = 1.0  # that the way to a first pose counts as, for friction
    rise_part: float = 0.25  # of that way that is a step: in one go flesh buckles
    # of such a part: growth and forces are there at once, whatever the part
    rise_factorizations: int = 150


@dataclass(frozen=True)
class Stepped:
    """A step's end, and what it took.

    ``y`` (p, 3) are the vertices in the head's frame, ``halvings`` how often the step had to be
    cut, ``residual`` that of its last part, ``inverted`` the number of inverted tets.
    """

    motion: Motion
    y: Floats
    iterations: int
    halvings: int
    residual: float
    seconds: float
    inverted: int


class Simulator:
    """Moves a face's flesh, quasi-statically or dynamically.

    Parameters
    ----------
    face
        The face; its material is in Pa.
    potentials
        What else has energy: contact.
    forces
        Forces from outside.
    dynamic
        Whether the flesh has inertia. Without, each moment is an equilibrium, and forces see
        velocities of zero.
    density
        (n,) of each tet, g/mm^3.
    damping
        Of motion relative to the head, per mass, 1/s.
    linear
        The linear solver, the fastest by default.
    tolerance, settled_mm
        A step ends at this residual, relative to nodal forces at unit strain, or when corrections
        stay shorter than this, root mean square over the vertices.
    options
        How a step is cut where it finds no end.
    """

    def __init__(
        self,
        face: Face,
        potentials: Sequence[Potential],
        forces: Sequence[Force],
        *,
        dynamic: bool,
        density: Floats,
        damping: float = 0.5,
        linear: str | None = None,
        tolerance: float = MOMENT.tolerance,
        settled_mm: float = MOMENT.settled_mm,
        options: SimulationOptions = SimulationOptions(),
    ) -> None:
        self._options = options
        self._face = face
        self._potentials = potentials
        self._forces = forces
        self._dynamic = dynamic
        self._damping = damping
        self._masses = lumped_masses(face.flesh, density)
        self._inertia = Inertia(face.flesh)
        self._flesh = face.flesh.plus(self._inertia)
        self._newton = Newton(
            self._flesh,
            potentials,
            options=replace(MOMENT, tolerance=tolerance, settled_mm=settled_mm),
            linear=linear or fastest(),
        )

    def rest(self, drive: Drive) -> Motion:
        """Return the face at rest in the pose, and under the forces, of ``drive``.

        Raises :class:`SolveError` as :meth:`step`, with the drive's own ``time``.
        """
        options = self._options
        start = replace(
            drive,
            time=drive.time - options.rise_seconds,
            A=self._flesh.passive(),
            jaw=np.zeros_like(drive.jaw),
        )
        rest = self._face.model.rest
        motion = Motion(drive.head(rest), np.zeros_like(rest), drive.head)
        try:
            return self._go(
                motion, start, drive, options.rise_part, options.rise_factorizations, dynamic=False
            ).motion
        except SolveError as error:
            # the way to the first pose is before all time
            error.context["time"] = drive.time
            raise

    def step(self, now: Motion, before: Drive, goal: Drive) -> Stepped:
        """Go from ``now``, where ``before`` led to, to ``goal``.

        Raises :class:`InputError` (``scene.times``) for a goal that is not later, and
        :class:`SolveError`: ``simulate.jammed``, ``simulate.diverged`` or ``solve.singular``, with
        the ``time`` that was not reached.
        """
        if not goal.time > before.time:
            raise InputError(
                "scene.times", f"a moment at {goal.time:g} s is not later than the one before"
            )
        return self._go(now, before, goal, 1.0, MOMENT.factorizations, dynamic=self._dynamic)

    def _go(
        self,
        now: Motion,
        before: Drive,
        goal: Drive,
        largest: float,
        factorisations: int,
        *,
        dynamic: bool,
    ) -> Stepped:
        """Go to ``goal`` in parts of the way, powers of two; none is larger than ``largest``.

        Each part may take so many ``factorisations``.
        """
        begun = perf_counter()
        done, part, drive = 0.0, largest, before
        iterations = halvings = 0
        while done < 1.0:
            target = before.toward(goal, done + part)
            try:
                now, minimum = self._once(now, drive, target, factorisations, dynamic=dynamic)
            except SolveError as error:
                if part == self._options.smallest_part:
                    error.context["time"] = target.time
                    raise
                self._newton.forget()
                part, halvings = 0.5 * part, halvings + 1
                continue
            drive, done = target, done + part
            iterations += minimum.iterations
            # a part begins at a multiple of itself, so that they add up to one
            while part < largest and done % (2.0 * part) == 0.0:
                part *= 2.0
        return Stepped(
            now,
            minimum.x,
            iterations,
            halvings,
            minimum.residual,
            perf_counter() - begun,
            self._flesh.inverted(minimum.x),
        )

    def _once(
        self, now: Motion, before: Drive, goal: Drive, factorisations: int, *, dynamic: bool
    ) -> tuple[Motion, Minimum]:
        """Take one step of backward Euler, or find one equilibrium."""
        seconds = goal.time - before.time
        into = goal.head.inverse()
        y = now.y
        self._inertia.release()
        if dynamic:
            flight = into(now.x + seconds * now.v)
            self._inertia.launch(self._masses, y, flight, seconds, self._damping)
        felt = replace(now, head=goal.head)
        for force in self._forces:
            self._inertia.load += into.turn(force.at(felt, goal.time))
        start = Boundary(y[self._flesh.held], before.jaw, _seen(now.head, before))
        end = Boundary(self._face.held_positions(goal.jaw), goal.jaw, _seen(goal.head, goal))
        for potential in self._potentials:
            potential.begin(y, start, seconds)
        minimum = self._newton.minimise(y, goal.A, start, end, factorisations)
        x = goal.head(minimum.x)
        v = (x - now.x) / seconds if dynamic else np.zeros_like(x)
        return Motion(x, v, goal.head), minimum


def _seen(head: Similarity, drive: Drive) -> tuple[Floats, ...]:
    """Return the objects in the frame of ``head``."""
    into = head.inverse()
    return tuple(into(each) for each in drive.objects)
