"""The flesh: tetrahedra between skin and bones, in front of and above the cut planes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.anatomy.tetrahedra import EdgeLengths, background_grid
from solver.surface import Floats, Ints, Surface

# Edge length in these regions as a part of the edge length elsewhere on the face.
FINE_REGIONS = {"upper_lip": 0.42, "lower_lip": 0.42, "eyes": 0.5, "nose": 0.5}
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


class Label(IntEnum):
    """Kind of a tetrahedron of the whole box."""

    OUTSIDE = 0
    FLESH = 1
    CRANIUM = 2
    MANDIBLE = 3
    CUT = 4


HOLDING = (Label.CRANIUM, Label.MANDIBLE, Label.CUT)


@dataclass(frozen=True)
class DomainOptions:
    """Extent of the box that is meshed, and edge lengths in it."""

    # Of the box around the skin, and of skin and bones that are followed behind the planes.
    margin_mm: float = 4.0
    plane_cells: int = 24  # a side of the triangle grids on the cut planes
    grid_mm: float = 6.0  # cells of the background mesh that carries the edge lengths
    # Edge length far from the face (neck, scalp, throat) as a multiple of the face's.
    deep_factor: float = 2.0
    growth: float = 0.4  # edge length in mm gained by a mm of distance
    # Pieces of flesh with a smaller part of the tetrahedra than this are dropped.
    least_piece: float = 0.05


DOMAIN = DomainOptions()


@dataclass(frozen=True)
class CutPlanes:
    """Cut planes: flesh lies in front of ``back_z`` and above ``bottom_y``, in mm."""

    back_z: float
    bottom_y: float

    @classmethod
    def of(cls, head: Template) -> CutPlanes:
        """Return the planes of a template."""
        return cls(head.back_z, head.bottom_y)

    def in_front(self, points: Floats, margin: float = 0.0) -> np.ndarray:
        """Return (n,) True where a point is at least ``margin`` inside both planes."""
        behind = points[..., 2] < self.back_z + margin
        below = points[..., 1] < self.bottom_y + margin
        return ~(behind | below)


def domain_soup(head: Template, options: DomainOptions = DOMAIN) -> Surface:
    """Return every triangle the tetrahedra have to follow: parted skin, bones and cut planes."""
    planes, margin = CutPlanes.of(head), options.margin_mm
    skin = Surface(head.parted_skin.vertices, head.skin.faces[head.flesh_faces])
    surfaces = [_clip(part, planes, margin) for part in (skin, head.cranium, head.mandible)]
    points = surfaces[0].vertices
    lo, hi = points.min(axis=0) - margin, points.max(axis=0) + margin
    lo = np.maximum(lo, [-np.inf, planes.bottom_y - margin, planes.back_z - margin])
    back = _sheet(lo, hi, 2, planes.back_z, options.plane_cells)
    bottom = _sheet(lo, hi, 1, planes.bottom_y, options.plane_cells)
    return join_surfaces([*surfaces, back, bottom])


def _clip(surface: Surface, planes: CutPlanes, margin: float) -> Surface:
    used = planes.in_front(surface.vertices[surface.faces], -margin).any(axis=1)
    numbers, faces = np.unique(surface.faces[used], return_inverse=True)
    return Surface(surface.vertices[numbers], faces.reshape(-1, 3).astype(np.int64))


def _sheet(lo: Floats, hi: Floats, axis: int, value: float, cells: int) -> Surface:
    u, v = (k for k in range(3) if k != axis)
    steps = np.arange(cells + 1) / cells
    grid_u, grid_v = np.meshgrid(steps, steps, indexing="ij")
    vertices = np.empty((grid_u.size, 3))
    vertices[:, axis] = value
    vertices[:, u] = lo[u] + grid_u.ravel() * (hi[u] - lo[u])
    vertices[:, v] = lo[v] + grid_v.ravel() * (hi[v] - lo[v])
    number = np.arange(grid_u.size).reshape(grid_u.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return Surface(vertices, faces.astype(np.int64))


def join_surfaces(surfaces: list[Surface]) -> Surface:
    """Return surfaces as one, their vertices and faces one after the other."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    return Surface(
        np.vstack([surface.vertices for surface in surfaces]),
        np.vstack([s.faces + start for s, start in zip(surfaces, starts, strict=True)]),
    )


def edge_lengths(
    head: Template, soup: Surface, edge_mm: float, options: DomainOptions = DOMAIN
) -> EdgeLengths:
    """Return wanted edge lengths: fine at lips, eyes and nose, ``edge_mm`` on the face."""
    grid = options.grid_mm
    lo, hi = soup.vertices.min(axis=0) - grid, soup.vertices.max(axis=0) + grid
    points, tets = background_grid(lo, hi, grid)
    lengths = np.full(len(points), options.deep_factor * edge_mm)
    wanted = [(head.face_vertices, 1.0)]
    wanted += [
        (head.regions[name], part) for name, part in FINE_REGIONS.items() if name in head.regions
    ]
    skin = head.parted_skin.vertices
    for vertices, part in wanted:
        distance = cKDTree(skin[vertices]).query(points)[0]
        grown = part * edge_mm + options.growth * np.maximum(distance - grid, 0)
        lengths = np.minimum(lengths, grown)
    return EdgeLengths(points, tets, lengths)


def label_tets(head: Template, vertices: Floats, tets: Ints) -> Ints:
    """Return the :class:`Label` (t,) of tetrahedra by winding numbers at their centres."""
    centres = vertices[tets].mean(axis=1)
    skin = Surface(head.parted_skin.vertices, head.skin.faces[head.flesh_faces])
    labels = np.where(_inside(skin, centres), Label.FLESH, Label.OUTSIDE)
    labels[(labels == Label.FLESH) & _inside(head.cranium, centres)] = Label.CRANIUM
    labels[(labels == Label.FLESH) & _inside(head.mandible, centres)] = Label.MANDIBLE
    labels[(labels == Label.FLESH) & ~CutPlanes.of(head).in_front(centres)] = Label.CUT
    return labels.astype(np.int64)


def _inside(surface: Surface, points: Floats) -> np.ndarray:
    winding = igl.fast_winding_number(surface.vertices, surface.faces, points)
    return np.asarray(winding) > 0.5


@dataclass(frozen=True)
class MeshedFlesh:
    """Kept tetrahedra in the parted pose.

    ``outside`` (f, 3) are the faces towards the air, the skin and its linings, ``outside_of`` (f,)
    their tets; ``held`` label -> vertex numbers on a bone or cut plane.
    """

    vertices: Floats
    tets: Ints
    outside: Ints
    outside_of: Ints
    held: dict[Label, Ints]


def choose_flesh(
    vertices: Floats, tets: Ints, labels: Ints, least_piece: float = DOMAIN.least_piece
) -> MeshedFlesh:
    """Return the flesh without tetrahedra that only stick things together, and its boundary.

    Dropped are tetrahedra with all vertices on bones or cut planes (nothing to solve for), those
    that bridge mandible and cranium (they would weld the joint), and loose pieces of less than
    ``least_piece`` of all.
    """
    flesh = labels == Label.FLESH
    sides = _faces_towards(tets, labels, np.flatnonzero(flesh))
    on = {}
    for label in HOLDING:
        # By the faces of all flesh, kept or not: what lies on a bone is held by it.
        on[label] = np.zeros(len(vertices), dtype=bool)
        on[label][sides[label][0]] = True
    fixed = np.any(list(on.values()), axis=0)
    bridge = on[Label.CRANIUM][tets].any(axis=1) & on[Label.MANDIBLE][tets].any(axis=1)
    kept = np.flatnonzero(flesh & ~bridge & ~fixed[tets].all(axis=1))
    kept = kept[_large_pieces(tets[kept], least_piece)]
    numbers, own = np.unique(tets[kept], return_inverse=True)
    renumber = np.full(len(vertices), -1)
    renumber[numbers] = np.arange(len(numbers))
    outside, owner = _faces_towards(tets, labels, kept)[Label.OUTSIDE]
    return MeshedFlesh(
        vertices[numbers],
        own.reshape(-1, 4),
        renumber[outside],
        np.searchsorted(kept, owner),
        {label: np.flatnonzero(mask[numbers]) for label, mask in on.items()},
    )


def _faces_towards(tets: Ints, labels: Ints, kept: Ints) -> dict[Label, tuple[Ints, Ints]]:
    """Return label -> faces of ``kept`` with such a tetrahedron, not itself kept, beyond.

    With the faces (f, 3) come the numbers (f,) of the kept tetrahedra they belong to.
    """
    faces = tets[:, _FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(tets)), 4)
    order = np.lexsort(np.sort(faces, axis=1).T)
    ordered = np.sort(faces, axis=1)[order]
    twin = np.full(len(faces), -1)
    same = np.flatnonzero((ordered[1:] == ordered[:-1]).all(axis=1))
    twin[order[same]], twin[order[same + 1]] = owner[order[same + 1]], owner[order[same]]
    is_kept = np.zeros(len(tets) + 1, dtype=bool)
    is_kept[kept] = True
    outer = is_kept[owner] & ~is_kept[twin]
    # Beyond the box there is nothing.
    beyond = np.append(labels, Label.OUTSIDE)[twin]
    sides = {label: outer & (beyond == label) for label in Label}
    return {label: (faces[side], owner[side]) for label, side in sides.items()}


def _large_pieces(tets: Ints, least_piece: float) -> np.ndarray:
    """Return (t,) True for tetrahedra in large pieces joined by faces."""
    faces = np.sort(tets[:, _FACES].reshape(-1, 3), axis=1)
    owner = np.repeat(np.arange(len(tets)), 4)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order][1:] == faces[order][:-1]).all(axis=1))
    pairs = owner[order[same]], owner[order[same + 1]]
    graph = sp.coo_array((np.ones(len(same)), pairs), shape=(len(tets), len(tets)))
    _, piece = connected_components(graph, directed=False)
    return np.asarray(np.bincount(piece)[piece] >= least_piece * len(tets))


def boundary(tets: Ints) -> Ints:
    """Return the faces (f, 3) that belong to one tetrahedron only, turned outwards."""
    faces = tets[:, _FACES].reshape(-1, 3)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.asarray(faces[first[count == 1]])
