"""Skin that may not cross skin or objects: the barrier of incremental potential contact.

An energy that grows without bound as two surfaces meet, friction that lags by a step, and steps
that end before anything crosses: Li et al., Incremental Potential Contact, SIGGRAPH 2020, by the
library ipctk. Objects are rigid; they lie where the boundary says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import ipctk
import numba as nb
import numpy as np
import scipy.sparse as sp

from solver.contact.surface import ContactSurface, collision_mesh
from solver.mechanics.boundary import Boundary, BoundaryRates
from solver.surface import Floats, Surface, join_surfaces


@dataclass(frozen=True)
class BarrierOptions:
    """Options of a barrier: its reach, and how steep it is."""

    distance_mm: float = 0.08  # surfaces nearer than this push: few are in a neutral face
    # of the barrier over the flesh's: pressed lips settle where it pushes firmly, not at its steep
    # end
    stiffness_ratio: float = 200.0
    # where Newton's step leads metres away, all is in the way of all, and to look for what it meets
    # takes seconds
    furthest_mm: float = 30.0
    # speed below which friction holds: it then grows with the speed, so that what is held creeps.
    # At 1 mm/s lips let a rod go by a millimetre in a second.
    slip_mm_s: float = 0.2


@dataclass(frozen=True)
class _Friction:
    """Contacts at a step's start, ``points`` (v, 3) then, and the step's length in seconds."""

    points: Floats
    collisions: ipctk.TangentialCollisions
    seconds: float

    def velocity(self, points: Floats) -> Floats:
        return np.asfortranarray((points - self.points) / self.seconds)


class Barrier:
    """A :class:`solver.mechanics.boundary.Potential` of the skin and of objects.

    ``surface`` is the skin that may touch, also ``itself``, and ``objects`` are closed surfaces,
    where they are to begin with. ``stiffness_pa`` is the flesh's, ``friction`` the coefficient of
    skin and objects.
    """

    def __init__(
        self,
        surface: ContactSurface,
        stiffness_pa: float,
        *,
        objects: Sequence[Surface] = (),
        itself: bool = True,
        friction: float = 0.0,
        options: BarrierOptions = BarrierOptions(),
    ) -> None:
        ipctk.set_logger_level(ipctk.error)
        ipctk.set_num_threads(nb.get_num_threads())
        self._options = options
        self._surface = surface
        self._objects = [each.vertices for each in objects]
        self._skin_size = 3 * len(surface.skin)  # coordinates, which come before the objects'
        self._rows = sp.csr_array(sp.kron(surface.rows, sp.eye_array(3), format="csr"))
        self._barrier = ipctk.BarrierPotential(
            options.distance_mm, options.stiffness_ratio * stiffness_pa
        )
        self._sliding = ipctk.FrictionPotential(options.slip_mm_s)
        self._friction = friction
        self._lagged: _Friction | None = None
        # x (p, 3), the surfaces' points (v, 3) there, and what touches
        self._last: tuple[Floats, Floats, ipctk.NormalCollisions] | None = None
        self._mesh = _join(surface, objects, itself=itself)

    def begin(self, x: Floats, now: Boundary, seconds: float) -> None:
        """See :class:`solver.mechanics.boundary.Potential`."""
        self.place(now)
        if not self._friction:
            return
        (points, collisions), lagged = self._touching(x), ipctk.TangentialCollisions()
        lagged.build(self._mesh, points, collisions, self._barrier, self._friction)
        self._lagged = _Friction(points, lagged, seconds)

    def place(self, boundary: Boundary) -> None:
        """See :class:`solver.mechanics.boundary.Potential`."""
        self._objects = list(boundary.objects)
        self._last = None

    def value(self, x: Floats) -> float:
        """See :class:`solver.mechanics.boundary.Potential`."""
        (points, collisions), lagged = self._touching(x), self._lagged
        value = float(self._barrier(collisions, self._mesh, points))
        if lagged is not None:
            speed = lagged.velocity(points)
            value += lagged.seconds * float(self._sliding(lagged.collisions, self._mesh, speed))
        return value

    def gradient(self, x: Floats) -> Floats:
        """See :class:`solver.mechanics.boundary.Potential`."""
        (points, collisions), lagged = self._touching(x), self._lagged
        force = self._barrier.gradient(collisions, self._mesh, points)
        if lagged is not None:
            speed = lagged.velocity(points)
            force = force + self._sliding.gradient(lagged.collisions, self._mesh, speed)
        return self._on_flesh(force)

    def hessian(self, x: Floats) -> sp.csr_array:
        """See :class:`solver.mechanics.boundary.Potential`."""
        return self._by_flesh(self._second(x, ipctk.PSDProjectionMethod.CLAMP))

    def curvature(self, x: Floats) -> sp.csr_array:
        """See :class:`solver.mechanics.boundary.Potential`."""
        return self._by_flesh(self._second(x, ipctk.PSDProjectionMethod.NONE))

    def by_boundary(self, x: Floats, rates: BoundaryRates) -> Floats:
        """See :class:`solver.mechanics.boundary.Potential`."""
        out = np.zeros((*x.shape, rates.count))
        if rates.objects:
            own = self._skin_size
            motion = np.concatenate(rates.objects).reshape(-1, rates.count)
            matrix = self._second(x, ipctk.PSDProjectionMethod.NONE)
            out += (self._rows.T @ (matrix[:own, own:] @ motion)).reshape(out.shape)
        return out

    def pull(self, x: Floats, goal: Boundary) -> Floats:
        """See :class:`solver.mechanics.boundary.Potential`."""
        if not self._objects:
            return np.zeros_like(x)
        motion = np.vstack(goal.objects) - np.vstack(self._objects)
        own = self._skin_size
        matrix = self._second(x, ipctk.PSDProjectionMethod.CLAMP)
        return self._on_flesh(matrix[:own, own:] @ motion.ravel())

    def max_step(self, x: Floats, y: Floats, goal: Boundary) -> float:
        """See :class:`solver.mechanics.boundary.Potential`."""
        start = self._points(x, self._objects)
        motion = self._points(y, goal.objects) - start
        far = float(np.linalg.norm(motion, axis=1).max(initial=0.0))
        part = min(self._options.furthest_mm / far, 1.0) if far else 1.0
        step = ipctk.compute_collision_free_stepsize(
            self._mesh, start, start + part * motion, 0.0, None, ipctk.AdditiveCCD()
        )
        return part * float(step)

    def _points(self, x: Floats, objects: Sequence[Floats]) -> Floats:
        return np.asfortranarray(np.vstack([self._surface.points(x), *objects]))

    def _touching(self, x: Floats) -> tuple[Floats, ipctk.NormalCollisions]:
        """Find what touches at x; value, gradient and Hessian ask for the same x again."""
        if self._last is None or not np.array_equal(self._last[0], x):
            points, collisions = self._points(x, self._objects), ipctk.NormalCollisions()
            collisions.build(self._mesh, points, self._options.distance_mm)
            self._last = x.copy(), points, collisions
        return self._last[1:]

    def _by_flesh(self, second: sp.csr_array) -> sp.csr_array:
        """Return the Hessian (3 p, 3 p) by the flesh from that by skin and objects."""
        own = self._skin_size
        by_skin = second[:own, :own]
        # few of the skin's vertices touch anything
        touching = np.flatnonzero(np.diff(by_skin.indptr))
        rows = self._rows[touching]
        return sp.csr_array(rows.T @ by_skin[touching][:, touching] @ rows)

    def _second(self, x: Floats, project: ipctk.PSDProjectionMethod) -> sp.csr_array:
        """Return the Hessian by the coordinates of skin and objects."""
        (points, collisions), lagged = self._touching(x), self._lagged
        matrix = self._barrier.hessian(collisions, self._mesh, points, project)
        if lagged is not None:
            speed = lagged.velocity(points)
            drag = self._sliding.hessian(lagged.collisions, self._mesh, speed, project)
            matrix = matrix + drag / lagged.seconds
        return sp.csr_array(matrix)

    def _on_flesh(self, force: Floats) -> Floats:
        """Return forces on the contact surface's coordinates as forces (p, 3) on the flesh."""
        return np.asarray(self._surface.rows.T @ force[: self._skin_size].reshape(-1, 3))


def _join(
    surface: ContactSurface, objects: Sequence[Surface], *, itself: bool
) -> ipctk.CollisionMesh:
    """Return skin and objects as one mesh, in which no object meets another one."""
    parts = [Surface(surface.rest, surface.faces), *objects]
    mesh = collision_mesh(join_surfaces(parts))
    sizes = np.array([len(part.vertices) for part in parts])
    # vertices of one patch do not meet
    patches = np.arange(1, sizes.sum() + 1) if itself else np.repeat(np.arange(len(sizes)), sizes)
    if itself:
        patches[: len(surface.skin)][surface.crossed] = 0
    # filters of the library's: one in Python would wait for ever on its threads
    apart = ipctk.make_vertex_patches_filter(patches.astype(np.int32))
    mesh.can_collide = ipctk.make_static_obstacle_filter(len(surface.skin)) & apart
    return mesh
