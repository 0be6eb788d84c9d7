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
from solver.surface import Floats, Ints, Surface, inside, join_surfaces, own_numbers, part_of

# Edge length in these regions as a part of the edge length elsewhere on the face.
FINE_REGIONS = {"upper_lip": 0.42, "lower_lip": 0.42, "eyes": 0.5, "nose": 0.5}
# Of a tetrahedron, turned outwards, in the order of libigl's adjacency.
_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


class Label(IntEnum):
    """Kind of a tetrahedron of the whole box."""

    OUTSIDE = 0
    FLESH = 1
    CRANIUM = 2
    MANDIBLE = 3
    CUT = 4


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


def in_front(head: Template, points: Floats, margin: float = 0.0) -> np.ndarray:
    """Return (n,) True where a point is at least ``margin`` inside both of a head's cut planes."""
    behind = points[..., 2] < head.back_z + margin
    return ~(behind | (points[..., 1] < head.bottom_y + margin))


def domain_soup(head: Template) -> Surface:
    """Return every triangle the tetrahedra have to follow: parted skin, bones and cut planes."""
    margin = DOMAIN.margin_mm
    cells = DOMAIN.plane_cells
    surfaces = []
    for part in (head.parted_flesh, head.cranium, head.mandible):
        ahead = in_front(head, part.vertices[part.faces], -margin).any(axis=1)
        surfaces.append(part_of(part, np.flatnonzero(ahead)))
    points = surfaces[0].vertices
    lo = points.min(axis=0) - margin
    hi = points.max(axis=0) + margin
    lo = np.maximum(lo, [-np.inf, head.bottom_y - margin, head.back_z - margin])
    back = _sheet(lo, hi, 2, head.back_z, cells)
    return join_surfaces([*surfaces, back, _sheet(lo, hi, 1, head.bottom_y, cells)])


def _sheet(lo: Floats, hi: Floats, axis: int, value: float, cells: int) -> Surface:
    u, v = (k for k in range(3) if k != axis)
    steps = np.indices((cells + 1, cells + 1)).reshape(2, -1) / cells
    vertices = np.empty((steps.shape[1], 3))
    vertices[:, axis] = value
    vertices[:, u] = lo[u] + steps[0] * (hi[u] - lo[u])
    vertices[:, v] = lo[v] + steps[1] * (hi[v] - lo[v])
    return Surface(vertices, split_quads(grid_quads(cells + 1, cells + 1)))


def grid_quads(rows: int, columns: int) -> Ints:
    """Return the quads (k, 4) between rows x columns vertices, numbered row by row."""
    number = np.arange(rows * columns).reshape(rows, columns)
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack(corners, -1).reshape(-1, 4)


def split_quads(quads: Ints) -> Ints:
    """Return triangles (2 k, 3): one half of every quad (k, 4), then the others."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def edge_lengths(head: Template, soup: Surface, edge_mm: float) -> EdgeLengths:
    """Return wanted edge lengths: fine at lips, eyes and nose, ``edge_mm`` on the face."""
    grid = DOMAIN.grid_mm
    lo = soup.vertices.min(axis=0) - grid
    hi = soup.vertices.max(axis=0) + grid
    points, tets = background_grid(lo, hi, grid)
    lengths = np.full(len(points), DOMAIN.deep_factor * edge_mm)
    fine = [(head.regions.get(name, ()), part) for name, part in FINE_REGIONS.items()]
    skin = head.parted_skin.vertices
    for vertices, part in [(head.face_vertices, 1.0), *fine]:
        if len(vertices) == 0:
            continue
        distance = cKDTree(skin[vertices]).query(points)[0]
        grown = part * edge_mm + DOMAIN.growth * np.maximum(distance - grid, 0)
        lengths = np.minimum(lengths, grown)
    return EdgeLengths(points, tets, lengths)


def label_tets(head: Template, vertices: Floats, tets: Ints) -> Ints:
    """Return the :class:`Label` (t,) of tetrahedra by winding numbers at their centres."""
    centres = vertices[tets].mean(axis=1)
    labels = np.where(inside(head.parted_flesh, centres), Label.FLESH, Label.OUTSIDE)
    labels[(labels == Label.FLESH) & inside(head.cranium, centres)] = Label.CRANIUM
    labels[(labels == Label.FLESH) & inside(head.mandible, centres)] = Label.MANDIBLE
    labels[(labels == Label.FLESH) & ~in_front(head, centres)] = Label.CUT
    return labels.astype(np.int64)


@dataclass(frozen=True)
class MeshedFlesh:
    """Kept tetrahedra in the parted pose."""

    vertices: Floats
    tets: Ints
    outside: Ints  # (f, 3) faces towards the air: the skin and its linings
    outside_of: Ints  # (f,) their tets
    held: dict[Label, Ints]  # vertex numbers on a bone or cut plane

    @property
    def held_vertices(self) -> Ints:
        """Return the numbers of all vertices on a bone or cut plane."""
        return np.unique(np.concatenate(list(self.held.values())))


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
    for label in (Label.CRANIUM, Label.MANDIBLE, Label.CUT):
        # By the faces of all flesh, kept or not: what lies on a bone is held by it.
        on[label] = np.zeros(len(vertices), dtype=bool)
        on[label][sides[label][0]] = True
    fixed = np.any(list(on.values()), axis=0)
    bridge = on[Label.CRANIUM][tets].any(axis=1) & on[Label.MANDIBLE][tets].any(axis=1)
    kept = np.flatnonzero(flesh & ~bridge & ~fixed[tets].all(axis=1))
    kept = kept[_large_pieces(tets[kept], least_piece)]
    numbers, own = own_numbers(tets[kept])
    outside, owner = _faces_towards(tets, labels, kept)[Label.OUTSIDE]
    return MeshedFlesh(
        vertices[numbers],
        own,
        np.searchsorted(numbers, outside),
        np.searchsorted(kept, owner),
        {label: np.flatnonzero(mask[numbers]) for label, mask in on.items()},
    )


def _faces_towards(tets: Ints, labels: Ints, kept: Ints) -> dict[Label, tuple[Ints, Ints]]:
    """Return label -> faces of ``kept`` with such a tetrahedron, not itself kept, beyond.

    With the faces (f, 3) come the numbers (f,) of the kept tetrahedra they belong to.
    """
    twin = igl.tet_tet_adjacency(tets)[0]
    is_kept = np.isin(np.arange(len(tets) + 1), kept)
    # Beyond the box, at -1, there is nothing.
    beyond = np.append(labels, Label.OUTSIDE)[twin]
    outer = is_kept[:-1, None] & ~is_kept[twin]
    sides = {}
    for label in Label:
        owner, side = np.nonzero(outer & (beyond == label))
        sides[label] = tets[owner[:, None], _FACES[side]], owner
    return sides


def _large_pieces(tets: Ints, least_piece: float) -> np.ndarray:
    """Return (t,) True for tetrahedra in large pieces joined by faces."""
    twin = igl.tet_tet_adjacency(tets)[0]
    owner, side = np.nonzero(twin >= 0)
    pairs = owner, twin[owner, side]
    graph = sp.coo_array((np.ones(len(owner)), pairs), shape=(len(tets), len(tets)))
    _, piece = connected_components(graph, directed=False)
    return np.asarray(np.bincount(piece)[piece] >= least_piece * len(tets))
