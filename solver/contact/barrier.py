"""Skin that may not cross skin or objects: the barrier of incremental potential contact.

An energy that grows without bound as two surfaces meet, friction that lags by a step, and steps
that end before anything crosses: Li et al., Incremental Potential Contact, SIGGRAPH 2020, by the
library ipctk. Objects are rigid; they lie where the boundary says.

Scans cross themselves where lips are closed, mostly by hundredths of a millimetre, and a barrier is
infinite there. So the contact surface lies ``inset_mm`` under the skin, with lips that cross moved
apart: two skins that touch may cross by twice that, or as far as in the neutral. What crosses
itself even so, as the thin walls of nostrils or the skin behind lids do in some people, does not
meet itself. (To go deeper there makes it worse: folds and thin walls cross all the more.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import ipctk
import numba as nb
import numpy as np
import scipy.sparse as sp
import structlog
from numpy.typing import NDArray
from typing_extensions import override

from solver.anatomy.embedding import rows_of
from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.contact.crossing import between_lips
from solver.contact.mouth import Mouth, area_weighted_normals
from solver.errors import InputError
from solver.mechanics.boundary import Boundary, BoundaryRates, Potential
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, adjacency, inside, join_surfaces, own_numbers

# The skin as contact sees it: its triangles that may touch, a little inside themselves.


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of the contact surface: its inset, and what may cross."""

    inset_mm: float = 0.06  # under the skin
    gap_mm: float = 0.02  # lips are moved so far beyond the place where they meet
    rounds: int = 20  # of moving them: a few are enough, as vertices pull on one another
    beside_mm: float = 0.02  # a vertex is looked at this far outside the contact surface
    most_crossed: float = 0.2  # part of the triangles that may cross


def part_lips(mouth: Mouth, points: Floats, options: SurfaceOptions = SurfaceOptions()) -> Floats:
    """Return the points (m, 3) of a mouth, both lips giving way by half of where they cross.

    Contact begins with these points where a scan's lips are closed.
    """
    count = len(points)
    for _ in range(options.rounds):
        found = between_lips(mouth, points)
        if not len(found.ids):
            break
        vertex = rows_of(found.ids[:, None], np.ones((len(found.ids), 1)), count)
        nearest = rows_of(found.corners, found.shares, count)
        half = 0.5 * (found.depth + options.gap_mm)[:, None] * found.out
        asked = np.asarray(sp.csr_array(vertex + nearest).sum(axis=0))
        moves = (vertex - nearest).T @ half
        points = points + moves / np.maximum(asked, 1.0)[:, None]
    return points


log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class ContactSurface:
    """Skin vertices that follow the flesh, under the skin, and the triangles between them.

    Positions are ``rows @ x + offset`` at the tets' vertices x. The inset is a part of ``rows``: it
    turns with the flesh.
    """

    skin: Ints  # (s,) skin vertices, sorted
    faces: Ints  # (f, 3) triangles, numbered by these
    rows: sp.csr_array  # (s, p)
    offset: Floats  # (s, 3)
    rest: Floats  # (s, 3) the positions in the neutral face
    crossed: NDArray[np.bool_]  # (s,) what crosses there, with its neighbours: no two of these meet

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        faces: Ints,
        mouth: Mouth | None = None,
        options: SurfaceOptions = SurfaceOptions(),
    ) -> ContactSurface:
        """Return the surface of some of the skin's triangles (f, 3), all on embedded vertices.

        The lips of a ``mouth`` are moved apart. Raises :class:`InputError` (``contact.crossed``)
        where the skin crosses itself widely.
        """
        skin, own = own_numbers(faces)
        number = np.searchsorted(model.embedded, skin)
        rows = sp.csr_array(model.embedding[number])
        offset = model.offset[number]
        points = np.asarray(rows @ model.rest + offset)
        normals = area_weighted_normals(points, own)
        apart = np.zeros_like(model.skin.vertices)
        if mouth is not None:
            lips = mouth.points(model.rest)
            apart[mouth.skin] = part_lips(mouth, lips, options) - lips
        shift = apart[skin] - options.inset_mm * normals
        moved = points + shift
        crossed = _mark_crossed(Surface(moved, own), normals, options.beside_mm)
        if crossed[own].any(axis=1).mean() > options.most_crossed:
            vertex = int(skin[crossed][0])
            message = f"the neutral skin crosses itself widely, around vertex {vertex}: mend it"
            raise InputError("contact.crossed", message, vertex=vertex)
        if crossed.any():
            log.info("skin that crosses itself does not meet itself", vertices=int(crossed.sum()))
        crossed |= adjacency(own, len(skin)) @ crossed > 0
        rows = _shift_rows(model, rows, shift)
        return cls(skin, own, rows, offset, moved, crossed)

    def points(self, x: Floats) -> Floats:
        """Return the positions (s, 3) at the tets' vertices x (p, 3)."""
        return np.asarray(self.rows @ x + self.offset)


def collision_mesh(surface: Surface) -> ipctk.CollisionMesh:
    """Return a surface as ipctk takes it."""
    corners = np.asfortranarray(surface.faces, dtype=np.int32)
    edges = np.asfortranarray(ipctk.edges(corners))
    return ipctk.CollisionMesh(np.asfortranarray(surface.vertices), edges, corners)


def _mark_crossed(surface: Surface, normals: Floats, beside_mm: float) -> NDArray[np.bool_]:
    """Mark (s,) the vertices that lie in flesh not under their own skin, or where skin crosses.

    The former by the winding number, as lips' overlap is found (:mod:`solver.contact.crossing`).
    """
    mesh = collision_mesh(surface)
    if not ipctk.has_intersections(mesh, mesh.rest_positions):
        return np.zeros(len(surface.vertices), dtype=np.bool_)
    marks = inside(surface, surface.vertices + beside_mm * normals)
    marks[crossing_vertices(mesh)] = True
    return marks


def crossing_vertices(mesh: ipctk.CollisionMesh) -> Ints:
    """Return the corners of triangles and the ends of edges that cross each other, sorted."""
    places = mesh.rest_positions
    grid = ipctk.HashGrid()
    grid.build(places, mesh.edges, mesh.faces)
    near = grid.detect_edge_face_candidates()
    if not near:
        return np.empty(0, dtype=np.int64)
    pairs = np.array([(each.edge_id, each.face_id) for each in near])
    corners = np.hstack([mesh.edges[pairs[:, 0]], mesh.faces[pairs[:, 1]]])
    crossed = [
        len({*each}) == 5 and ipctk.is_edge_intersecting_triangle(*places[each]) for each in corners
    ]
    return np.unique(corners[np.array(crossed)]).astype(np.int64)


def _shift_rows(model: SubjectModel, rows: sp.csr_array, shift: Floats) -> sp.csr_array:
    """Return rows whose points lie at rest by ``shift`` (s, 3) off, and turn with their tets."""
    corners = rows.indices.reshape(-1, 4)
    shares = rows.data.reshape(-1, 4)
    places = model.rest[corners]
    points = np.einsum("sc,sci->si", shares, places)
    change = barycentric_in_tets(points + shift, places) - barycentric_in_tets(points, places)
    return rows_of(corners, shares + change, len(model.rest))


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


class Barrier(Potential):
    """The potential of the skin and of objects.

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

    @override
    def begin(self, x: Floats, now: Boundary, seconds: float) -> None:
        self.place(now)
        if not self._friction:
            return
        (points, collisions), lagged = self._touching(x), ipctk.TangentialCollisions()
        lagged.build(self._mesh, points, collisions, self._barrier, self._friction)
        self._lagged = _Friction(points, lagged, seconds)

    @override
    def place(self, boundary: Boundary) -> None:
        self._objects = list(boundary.objects)
        self._last = None

    def contacts(self, x: Floats) -> int:
        """Return how many pairs of points, edges and triangles are near enough to push."""
        return len(self._touching(x)[1])

    @override
    def value(self, x: Floats) -> float:
        (points, collisions), lagged = self._touching(x), self._lagged
        value = float(self._barrier(collisions, self._mesh, points))
        if lagged is not None:
            speed = lagged.velocity(points)
            value += lagged.seconds * float(self._sliding(lagged.collisions, self._mesh, speed))
        return value

    @override
    def gradient(self, x: Floats) -> Floats:
        (points, collisions), lagged = self._touching(x), self._lagged
        force = self._barrier.gradient(collisions, self._mesh, points)
        if lagged is not None:
            speed = lagged.velocity(points)
            force = force + self._sliding.gradient(lagged.collisions, self._mesh, speed)
        return self._on_flesh(force)

    @override
    def hessian(self, x: Floats) -> sp.csr_array:
        return self._by_flesh(self._second(x, ipctk.PSDProjectionMethod.CLAMP))

    @override
    def curvature(self, x: Floats) -> sp.csr_array:
        return self._by_flesh(self._second(x, ipctk.PSDProjectionMethod.NONE))

    @override
    def by_boundary(self, x: Floats, rates: BoundaryRates) -> Floats:
        out = np.zeros((*x.shape, rates.count))
        if rates.objects:
            own = self._skin_size
            motion = np.concatenate(rates.objects).reshape(-1, rates.count)
            matrix = self._second(x, ipctk.PSDProjectionMethod.NONE)
            out += (self._rows.T @ (matrix[:own, own:] @ motion)).reshape(out.shape)
        return out

    @override
    def pull(self, x: Floats, goal: Boundary) -> Floats:
        if not self._objects:
            return np.zeros_like(x)
        motion = np.vstack(goal.objects) - np.vstack(self._objects)
        own = self._skin_size
        matrix = self._second(x, ipctk.PSDProjectionMethod.CLAMP)
        return self._on_flesh(matrix[:own, own:] @ motion.ravel())

    @override
    def max_step(self, x: Floats, y: Floats, goal: Boundary) -> float:
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
            points = self._points(x, self._objects)
            collisions = ipctk.NormalCollisions()
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
