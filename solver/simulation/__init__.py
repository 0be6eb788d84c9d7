"""A face in motion: from where it is to where a moment's activations, jaw and forces take it.

Every unknown is in the head's frame, whatever the head does: see :mod:`solver.simulation.forces`.
A step that finds no end is halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.mechanics.boundary import Boundary, Potential
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import GrowingSolver, fastest
from solver.mechanics.newton import Energy, Factorization, NewtonOptions, Search
from solver.similarity import Similarity
from solver.simulation.forces import Drive, ExternalForce, FleshMotion, Inertia, lumped_masses
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
class SimulationOptions:
    """Options of a simulation: how a step is cut, and how the first pose is reached."""

    smallest_part: float = 2.0**-6  # of a step: it is not cut further
    rise_seconds: float = 1.0  # that the way to a first pose counts as, for friction
    rise_part: float = 0.25  # of that way that is a step: in one go flesh buckles
    # of such a part: growth and forces are there at once, whatever the part
    rise_factorizations: int = 150


@dataclass(frozen=True)
class Stepped:
    """A step's end, and what it took."""

    motion: FleshMotion
    y: Floats  # (p, 3) vertices in the head's frame
    iterations: int
    halvings: int  # how often the step had to be cut
    residual: float  # of its last part
    seconds: float
    inverted: int  # number of inverted tets


class Simulator:
    """Moves the flesh of a face, whose material is in Pa.

    ``dynamic`` flesh has inertia; without, each moment is an equilibrium, and forces see velocities
    of zero. ``density`` (n,) is each tet's in g/mm^3, ``damping`` that of motion relative to the
    head, per mass, in 1/s. ``linear`` is the linear solver, the fastest by default. A step ends as
    :class:`~solver.mechanics.newton.NewtonOptions` say of ``tolerance`` and ``settled_mm``.
    """

    def __init__(
        self,
        face: Face,
        potentials: Sequence[Potential],
        forces: Sequence[ExternalForce],
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
        newton = replace(MOMENT, tolerance=tolerance, settled_mm=settled_mm)
        self._newton = _Newton(self._flesh, potentials, newton, linear or fastest())

    def rest(self, drive: Drive) -> FleshMotion:
        """Return the face at rest where ``drive`` has it, under forces; raises as :meth:`step`."""
        options = self._options
        closed = np.zeros_like(drive.jaw)
        begun = drive.time - options.rise_seconds
        start = replace(drive, time=begun, A=self._flesh.passive(), jaw=closed)
        rest = self._face.model.rest
        motion = FleshMotion(drive.head(rest), np.zeros_like(rest), drive.head)
        effort = options.rise_part, options.rise_factorizations
        try:
            return self._go(motion, start, drive, *effort, dynamic=False).motion
        except SolveError as error:
            # the way to the first pose is before all time
            error.context["time"] = drive.time
            raise

    def step(self, now: FleshMotion, before: Drive, goal: Drive) -> Stepped:
        """Go from ``now``, where ``before`` led to, to ``goal``.

        Raises :class:`InputError` (``scene.times``) for a goal that is not later, and
        :class:`SolveError`: ``simulate.jammed``, ``simulate.diverged`` or ``solve.singular``, with
        the ``time`` that was not reached.
        """
        if not goal.time > before.time:
            message = f"a moment at {goal.time:g} s is not later than the one before"
            raise InputError("scene.times", message)
        return self._go(now, before, goal, 1.0, MOMENT.factorizations, dynamic=self._dynamic)

    def _go(
        self,
        now: FleshMotion,
        before: Drive,
        goal: Drive,
        largest: float,
        factorisations: int,
        *,
        dynamic: bool,
    ) -> Stepped:
        """Go to ``goal`` in parts of the way, powers of two of at most ``largest``."""
        begun = perf_counter()
        done = 0.0
        part = largest
        drive = before
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
                part = 0.5 * part
                halvings = halvings + 1
                continue
            drive = target
            done = done + part
            iterations += minimum.steps
            # a part begins at a multiple of itself, so that they add up to one
            while part < largest and done % (2.0 * part) == 0.0:
                part *= 2.0
        y = minimum.x
        inverted = self._flesh.count_inverted(minimum.x)
        seconds = perf_counter() - begun
        return Stepped(now, y, iterations, halvings, minimum.residual, seconds, inverted)

    def _once(
        self, now: FleshMotion, before: Drive, goal: Drive, factorisations: int, *, dynamic: bool
    ) -> tuple[FleshMotion, Search]:
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
        return FleshMotion(x, v, goal.head), minimum


def _seen(head: Similarity, drive: Drive) -> tuple[Floats, ...]:
    """Return the objects in the frame of ``head``."""
    into = head.inverse()
    return tuple(into(each) for each in drive.objects)


@dataclass(frozen=True)
class AdvanceOptions:
    """Options of the boundary's way to its goal."""

    steps: int = 40  # at most
    same: float = 1e-9  # difference of two places, in mm, that is rounding
    jammed: float = 1e-3  # part of the way that a step gains at least ...
    jams: int = 5  # ... or it may gain less so often


class _Newton:
    """Minimises the energy of ``flesh`` and ``potentials`` with bones and objects on their way.

    Energies with barriers are infinite where things cross, so neither the flesh nor what is rigid
    can jump to its place. Both advance together: a step is Newton's, with the pull of what the
    rigid parts will do, so that flesh is pushed before it is reached, and goes as far as nothing
    crosses. Then the energy falls to its minimum. What was factorised last serves again.
    """

    def __init__(
        self, flesh: Flesh, potentials: Sequence[Potential], options: NewtonOptions, linear: str
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
        self, x: Floats, a: Floats, now: Boundary, goal: Boundary, factorizations: int
    ) -> Search:
        """Go from x (p, 3) at ``now`` to the least energy at ``goal`` with activations a (n, 6).

        Raises :class:`SolveError`: ``simulate.jammed`` where the boundary gets no further,
        ``simulate.diverged`` where the energy comes to no minimum.
        """
        energy = Energy(self._flesh, self._solver, a, self._potentials, goal)
        x, advances = self._advance(energy, x, now, goal)
        options = replace(self._options, factorizations=factorizations)
        search = Search(energy, x, options, self._factor, self._projection)
        try:
            search.minimise()
        finally:
            self._factor = search.factorization
            self._projection = search.projection
        # NaN, too, is no minimum
        if not search.residual <= max(options.stalled, options.tolerance):
            steps = search.steps
            residual = search.residual
            message = f"the flesh found no rest: a residual of {residual:.1e} after {steps} steps"
            raise SolveError("simulate.diverged", message, residual=residual)
        search.steps += advances
        return search

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
        old = self._factor is not None
        steps = 0
        jams = 0
        while not now.same_as(goal, options.same):
            if self._factor is None:
                self._factor = energy.factorization(x, max(self._projection - 1, 0))
                self._projection = self._factor.projection
            motion = np.zeros_like(x)
            motion[held] = goal.held - x[held]
            force = energy.gradient(x) + self._pull(energy, x, motion, goal)
            y = self._flesh.add_motion(x + motion, -self._factor.solve(force))
            part = energy.max_step(x, y, self._options)
            if part < 1.0 and old:
                # an old factor knows nothing of what is in the way now
                self._factor = None
                old = False
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
