"""The skin as contact sees it: its triangles that may touch, a little inside themselves.

Scans cross themselves where lips are closed, mostly by hundredths of a millimetre, and a barrier is
infinite there. So the contact surface lies ``inset_mm`` under the skin, with lips that cross moved
apart: two skins that touch may cross by twice that, or as far as in the neutral. What crosses
itself even so, as the thin walls of nostrils or the skin behind lids do in some people, does not
meet itself. (To go deeper there makes it worse: folds and thin walls cross all the more.)
"""

from __future__ import annotations

from dataclasses import dataclass

import ipctk
import numpy as np
import scipy.sparse as sp
import structlog
from numpy.typing import NDArray

from solver.anatomy.embedding import rows_of
from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.contact.crossing import between_lips
from solver.contact.mouth import Mouth, area_weighted_normals
from solver.errors import InputError
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, adjacency, inside, own_numbers


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

    That is what contact of a scan with closed lips begins with.
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

    skin, faces
        (s,) skin vertices, sorted, and (f, 3) triangles, numbered by these.
    rows, offset
        (s, p) CSR and (s, 3): positions are ``rows @ x + offset`` at the tets' vertices x. The
        inset is a part of ``rows``: it turns with the flesh.
    rest
        (s, 3) the positions in the neutral face.
    crossed
        (s,) bool, what crosses there, with its neighbours: no two of these meet.
    """

    skin: Ints
    faces: Ints
    rows: sp.csr_array
    offset: Floats
    rest: Floats
    crossed: NDArray[np.bool_]

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
        rows, offset = sp.csr_array(model.embedding[number]), model.offset[number]
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
    places, grid = mesh.rest_positions, ipctk.HashGrid()
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
    corners, shares = rows.indices.reshape(-1, 4), rows.data.reshape(-1, 4)
    places = model.rest[corners]
    points = np.einsum("sc,sci->si", shares, places)
    change = barycentric_in_tets(points + shift, places) - barycentric_in_tets(points, places)
    return rows_of(corners, shares + change, len(model.rest))
