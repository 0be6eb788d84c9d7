"""A raw scan made ready for questions: which point is closest, and is that an edge of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree, cKDTree
from typing_extensions import override

from solver.errors import InputError
from solver.meshio.mesh import alike
from solver.meshio.raw import RawScan
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface, adjacency, area_normals, part_of, unit_rows

NEIGHBOURS = 12  # of a point of a cloud, on a plane


@dataclass(frozen=True)
class ScanSurfaceOptions:
    """Preparing a scan for closest points; lengths in mm."""

    # more is thinned: a 1.5 mm grid on a head, below a template's edges
    max_vertices: int = 120_000
    least_vertices: int = 100  # of a scan
    normal_radius: float = 2.5  # of the mean, as noise turns small triangles
    small_piece: float = 0.01  # share of the area under which a piece is debris
    cloud_neighbours: int = NEIGHBOURS  # of a point, on a plane
    turn: float = 20.0  # a turn by a radian counts as this distance
    compatible_neighbours: int = 3  # that are averaged
    samples: int = 60_000  # points that stand for a scan ...
    # ... and how many a leaf of their tree holds: with 10 a face far off takes three times as long
    leaf: int = 64


SURFACE = ScanSurfaceOptions()


@dataclass(frozen=True)
class Matches:
    """The closest points of a scan."""

    points: Floats  # (n, 3)
    normals: Floats  # (n, 3), of length 1
    distance: Floats  # (n,) in the scan's unit
    at_edge: NDArray[np.bool_]  # (n,) there is no data beyond


class ScanSurface(ABC):
    """A scan with outward unit ``normals`` (n, 3) at its ``vertices`` (n, 3)."""

    def __init__(self, surface: Surface, normals: Floats) -> None:
        self.vertices = surface.vertices
        self.faces = surface.faces
        self.normals = normals
        self._directed_tree = cKDTree(np.hstack([self.vertices, SURFACE.turn * normals]))

    @abstractmethod
    def closest(self, points: Floats) -> Matches:
        """Return the closest points of the scan to ``points`` (n, 3)."""

    @abstractmethod
    def _at_edge(self, points: Floats, near: Ints) -> NDArray[np.bool_]:
        """Return which ``points`` (n, 3) or vertices (n, k) ``near`` them are at an edge."""

    def closest_compatible(self, points: Floats, normals: Floats) -> Matches:
        """Return means of vertices that are close and face the same way as ``normals`` (n, 3).

        Places and directions are compared together, as in White et al. (Sci. Rep. 2019).
        """
        places = np.hstack([points, SURFACE.turn * normals])
        apart, near = self._directed_tree.query(places, SURFACE.compatible_neighbours)
        weights = 1 / (apart + 0.5) ** 2
        place, direction = self._means(weights, near)
        distance = np.linalg.norm(points - place, axis=1)
        return Matches(place, direction, distance, self._at_edge(points, near))

    def _means(self, weights: Floats, near: Ints) -> tuple[Floats, Floats]:
        """Return places and unit normals (n, 3) of vertices ``near`` (n, k), by ``weights``."""
        weights = weights / weights.sum(axis=1, keepdims=True)
        place = np.einsum("nk,nkd->nd", weights, self.vertices[near])
        return place, unit_rows(np.einsum("nk,nkd->nd", weights, self.normals[near]))


def scan_surface(scan: RawScan, mm_per_unit: float) -> ScanSurface:
    """Return a mended scan in mm ready for registration: thinned, no debris, normals outward.

    Raises :class:`InputError` (``scan.empty``) if next to nothing is left.
    """
    vertices = mm_per_unit * scan.vertices
    if len(scan.faces):
        surface = Surface(vertices, scan.faces)
        if len(vertices) > SURFACE.max_vertices:
            surface = _thin(surface, SURFACE.max_vertices)
        graph = adjacency(surface.faces, len(surface.vertices))
        piece = connected_components(graph, directed=False)[1][surface.faces[:, 0]]
        area = np.nan_to_num(igl.doublearea(surface.vertices, surface.faces))
        share = np.bincount(piece, area) / max(float(area.sum()), 1e-12)
        surface = part_of(surface, np.flatnonzero(share[piece] >= SURFACE.small_piece))
        check_size(len(surface.vertices), scan.file)
        return MeshScan(turned_outward(surface))
    points = _thin_points(vertices, SURFACE.max_vertices)
    check_size(len(points), scan.file)
    return CloudScan(points)


class MeshScan(ScanSurface):
    """A triangle mesh; its closest points lie on triangles."""

    def __init__(self, surface: Surface) -> None:
        super().__init__(surface, _smooth_normals(surface, SURFACE.normal_radius))
        edges, face, corner = igl.boundary_facets(self.faces)
        self._edge_opposite = np.zeros(self.faces.shape, bool)
        self._edge_opposite[face, corner] = True
        self._edge_vertex = np.zeros(len(self.vertices), bool)
        self._edge_vertex[edges] = True
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    @override
    def closest(self, points: Floats) -> Matches:
        squared, face, near = self._tree.squared_distance(self.vertices, self.faces, points)
        corners = self.faces[face]
        weights = igl.barycentric_coordinates(near, *self.vertices[corners].swapaxes(0, 1))
        weights = np.clip(np.nan_to_num(weights), 0.0, 1.0)
        normals = unit_rows(np.einsum("nk,nkd->nd", weights, self.normals[corners]))
        on_edge = (self._edge_opposite[face] & (weights < 1e-4)).any(axis=1)
        at_vertex = (self._edge_vertex[corners] & (weights > 1 - 1e-4)).any(axis=1)
        return Matches(near, normals, np.sqrt(squared), on_edge | at_vertex)

    def _at_edge(self, _points: Floats, near: Ints) -> NDArray[np.bool_]:
        return np.asarray(self._edge_vertex[near].any(axis=1))


class CloudScan(ScanSurface):
    """Points without triangles; its closest points lie on planes through neighbours."""

    def __init__(self, points: Floats) -> None:
        self._tree = cKDTree(points)
        distance, near = self._tree.query(points, SURFACE.cloud_neighbours)
        self._spacing = float(np.median(distance[:, -1]))
        samples = orient_outward(Samples(points, estimated_normals(points, points), False))
        normals = unit_rows(samples.normals[near].mean(axis=1))
        super().__init__(Surface(points, np.zeros((0, 3), np.int64)), normals)

    @override
    def closest(self, points: Floats) -> Matches:
        distance, near = self._tree.query(points, SURFACE.cloud_neighbours)
        centre, normals = self._means(1 / (distance**2 + (0.3 * self._spacing) ** 2), near)
        height = np.einsum("nd,nd->n", points - centre, normals)
        foot = points - height[:, None] * normals
        beside = np.linalg.norm(foot - centre, axis=1)
        far = beside > 0.8 * self._spacing
        foot[far] = centre[far]
        return Matches(foot, normals, np.linalg.norm(points - foot, axis=1), far)

    def _at_edge(self, points: Floats, _near: Ints) -> NDArray[np.bool_]:
        return self.closest(points).at_edge


def check_size(count: int, file: str) -> None:
    """Raise :class:`InputError` (``scan.empty``) for a scan of next to nothing."""
    if count < SURFACE.least_vertices:
        message = f"{file} holds only {count} usable points; a face needs thousands"
        raise InputError("scan.empty", message, file=file, found=count)


def _thin(surface: Surface, most: int) -> Surface:
    """Cluster vertices on a grid, as fine as ``most`` vertices allow (Rossignac 1993).

    Faces that then use a vertex twice or lie on another go.
    """
    area = float(igl.doublearea(surface.vertices, surface.faces).sum()) / 2
    cell = 1.2 * np.sqrt(area / most)
    _, number = cells(surface.vertices, cell)
    faces = number[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    first, _ = alike(np.sort(faces, axis=1).astype(np.uint64))
    thinned = Surface(mean_by_cell(surface.vertices, number), faces)
    return part_of(thinned, first)


def _thin_points(points: Floats, most: int) -> Floats:
    low, high = np.quantile(points, [0.01, 0.99], axis=0)  # whatever strays far off
    cell = float((high - low).max()) / 400
    while len(points) > most:
        points = mean_by_cell(points, cells(points, cell)[1])
        cell = 1.2 * cell
    return points


def cells(points: Floats, size: float) -> tuple[Ints, Ints]:
    """Return the first point of every cell of a grid, and the cell of every point."""
    keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    wide = keys.max(axis=0, initial=0) + 1
    packed = (keys[:, 0] * wide[1] + keys[:, 1]) * wide[2] + keys[:, 2]
    _, first, number = np.unique(packed, return_index=True, return_inverse=True)
    return first, number


def mean_by_cell(values: Floats, number: Ints) -> Floats:
    """Return the means (c, 3) of the values (n, 3) in each cell, given the cell of each."""
    sums = np.stack([np.bincount(number, column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(number)[:, None])


def turned_outward(surface: Surface) -> Surface:
    """Return a scan's surface, all triangles flipped where most of them look inward."""
    normal = area_normals(surface.vertices, surface.faces)
    away = surface.vertices[surface.faces].mean(axis=1) - np.median(surface.vertices, axis=0)
    return surface.flipped() if float(np.sum(normal * away)) < 0 else surface


def _smooth_normals(surface: Surface, radius: float) -> Floats:
    corners = surface.vertices[surface.faces]
    normal = area_normals(surface.vertices, surface.faces)
    count = len(surface.vertices)
    sums = np.zeros((count, 3))
    np.add.at(sums, surface.faces.T, normal)
    edge = float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))
    steps = int(np.clip((radius / edge) ** 2, 0, 30))
    mean = adjacency(surface.faces, count) + sp.eye_array(count, format="csr")
    for _ in range(steps):
        sums = unit_rows(mean @ sums)
    return unit_rows(sums)


@dataclass(frozen=True)
class Samples:
    """Points (n, 3) of a scan with unit normals (n, 3), of either sign unless ``oriented``."""

    points: Floats
    normals: Floats
    oriented: bool

    @cached_property
    def tree(self) -> KDTree:
        """A tree of the points."""
        return KDTree(self.points, SURFACE.leaf)

    def transform(self, motion: Similarity) -> Samples:
        """Return the samples in another frame."""
        return Samples(motion(self.points), motion.turn(self.normals), self.oriented)


def sample(
    vertices: Floats, faces: Ints, normals: Floats | None = None, count: int = SURFACE.samples
) -> Samples:
    """Return about ``count`` points, spread by area over triangles or by space over a cloud.

    All vertices must be finite. Without faces or ``normals`` the normals are found from the
    neighbours, and their signs mean nothing.
    """
    rng = np.random.default_rng(0)
    if not len(faces):
        chosen = _spread(vertices, count, rng)
        points = vertices[chosen]
        if normals is None:
            return Samples(points, estimated_normals(points, vertices), False)
        return Samples(points, unit_rows(np.nan_to_num(normals[chosen])), True)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = area_normals(vertices, faces)
    area = np.linalg.norm(cross, axis=1)
    ends = np.cumsum(area)
    if ends[-1] <= 0:
        return Samples(vertices[:1], np.array([[0.0, 0.0, 1.0]]), False)
    steps = (np.arange(count) + rng.random(count)) / count
    chosen = np.minimum(np.searchsorted(ends, steps * ends[-1]), len(faces) - 1)
    u, v = rng.random((2, count, 1))
    beyond = u + v > 1
    u = np.where(beyond, 1 - u, u)
    v = np.where(beyond, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return Samples(points, unit_rows(cross[chosen]), True)


def _spread(points: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Return the numbers of one random point of each cube of a grid with about ``count`` cubes."""
    if len(points) <= count:
        return np.arange(len(points))
    order = rng.permutation(len(points))
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    size = float((high - low).max())
    cells = np.sqrt(count / 2)  # a surface in a cube of n cells a side passes about 2 n^2 of them
    for _ in range(4):
        numbers = np.floor((points[order] - low) / (size / cells + 1e-30)).astype(np.int64)
        keys = (numbers * np.array([1, 1_000_003, 1_000_003**2])).sum(axis=1)
        _, first = np.unique(keys, return_index=True)
        if 0.7 < len(first) / count < 1.4:
            break
        cells *= np.sqrt(count / len(first))
    return np.asarray(order[np.sort(first)[:count]], np.int64)


def estimated_normals(points: Floats, cloud: Floats) -> Floats:
    """Return normals (n, 3), of either sign, of planes through the neighbours in ``cloud``."""
    _, near = KDTree(cloud).query(points, k=min(NEIGHBOURS, len(cloud)))
    offsets = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    return np.asarray(axes[:, :, 0])


def orient_outward(samples: Samples) -> Samples:
    """Return the samples with normals that point outwards, whatever the scan's winding is."""
    points = samples.points
    normals = samples.normals.copy()
    away = points - np.median(points, axis=0)
    height = np.einsum("nd,nd->n", normals, away)
    if samples.oriented:
        return samples if height.sum() >= 0 else Samples(points, -normals, True)
    normals *= np.sign(height + 1e-12)[:, None]
    near = KDTree(points).query(points, NEIGHBOURS)[1]
    for _ in range(8):
        mean = normals[near].mean(axis=1)
        normals *= np.sign(np.einsum("nd,nd->n", normals, mean) + 1e-12)[:, None]
    return Samples(points, normals, False)
