"""A triangle surface: the plainest thing that anatomy, scans and pictures share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Surface:
    """Triangles in space: ``vertices`` (n, 3) in mm, ``faces`` (f, 3) vertex numbers."""

    vertices: Floats
    faces: Ints

    def with_vertices(self, vertices: Floats) -> Surface:
        """Return the same triangles with other vertex positions, shape (n, 3)."""
        return Surface(vertices, self.faces)

    def flipped(self) -> Surface:
        """Return the surface with its triangles wound the other way."""
        return Surface(self.vertices, np.ascontiguousarray(self.faces[:, ::-1]))


def vertex_normals(surface: Surface) -> Floats:
    """Return unit vertex normals (n, 3); a vertex without area gets (0, 0, 1)."""
    normals = np.asarray(igl.per_vertex_normals(surface.vertices, surface.faces))
    length = np.linalg.norm(normals, axis=1)
    flat = ~(length > 0.5)
    normals[flat] = (0.0, 0.0, 1.0)
    return normals / np.where(flat, 1.0, length)[:, None]


# Triangles of any kind: their edges, neighbours, normals and areas.


def directed_edges(faces: Ints) -> Ints:
    """Return the sides (3 f, 2) of triangles, as these run along them: all first sides first."""
    return np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def edge_keys(faces: Ints, *, directed: bool) -> Ints:
    """Return a number (3 f,) for the edge that each of :func:`directed_edges` is of."""
    ends = directed_edges(faces)
    one, other = (ends if directed else np.sort(ends, axis=1)).T
    return np.asarray(one * (int(faces.max(initial=0)) + 1) + other, np.int64)


def side_pairs(faces: Ints) -> Ints:
    """Return pairs (k, 2) of :func:`directed_edges` that are one edge of two triangles."""
    keys = edge_keys(faces, directed=False)
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    return np.column_stack([order[:-1][same], order[1:][same]])


def adjacency(faces: Ints, count: int) -> sp.csr_array:
    """Return the symmetric (count, count) matrix with 1 for every pair of vertices on an edge."""
    ends = np.roll(faces, 1, axis=1)
    rows = np.concatenate([faces.ravel(), ends.ravel()])
    columns = np.concatenate([ends.ravel(), faces.ravel()])
    graph = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    graph.data[:] = 1.0
    return graph


def area_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return normals (f, 3) of triangles, each as long as twice the area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def unit_rows(vectors: Floats) -> Floats:
    """Return vectors (..., 3) of length 1; those of no length stay."""
    return np.asarray(vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-30))


def skew(vectors: Floats) -> Floats:
    """Return the matrices (..., 3, 3) of v x . for ``vectors`` (..., 3)."""
    out = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    out[..., 0, 1] = -z
    out[..., 0, 2] = y
    out[..., 1, 2] = -x
    out[..., 1, 0] = z
    out[..., 2, 0] = -y
    out[..., 2, 1] = x
    return out


def vertex_areas(vertices: Floats, faces: Ints) -> Floats:
    """Return the area (n,) that belongs to each vertex: a third of its triangles'."""
    area = np.linalg.norm(area_normals(vertices, faces), axis=1) / 6
    sums = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices))
    return np.asarray(sums, np.float64)


# Parts of surfaces, surfaces joined, and what lies inside of them.


def own_numbers(corners: Ints) -> tuple[Ints, Ints]:
    """Return the vertices (k,) that triangles or tets use, sorted, and these numbered by them."""
    used, own = np.unique(corners, return_inverse=True)
    return used, own.reshape(corners.shape).astype(np.int64)


def faces_within(faces: Ints, vertices: Ints) -> NDArray[np.bool_]:
    """Return which triangles (f,) have all their corners among ``vertices`` (k,)."""
    return np.asarray(np.isin(faces, vertices).all(axis=1))


def part_of(surface: Surface, faces: Ints) -> Surface:
    """Return some faces of a surface, by their numbers, with the vertices that they use."""
    used, own = own_numbers(surface.faces[faces])
    return Surface(surface.vertices[used], own)


def join_surfaces(surfaces: Sequence[Surface]) -> Surface:
    """Return surfaces as one, their vertices and faces one after the other."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    return Surface(
        np.vstack([surface.vertices for surface in surfaces]),
        np.vstack([s.faces + start for s, start in zip(surfaces, starts, strict=True)]),
    )


def winding_numbers(surface: Surface, points: Floats) -> Floats:
    """Return how often (n,) a surface winds around points: near 1 inside, near 0 outside.

    That holds for surfaces with holes too (Jacobson et al. 2013).
    """
    places = np.ascontiguousarray(points)
    return np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, places))


def inside(surface: Surface, points: Floats) -> NDArray[np.bool_]:
    """Tell which of points (n, 3) lie inside a surface that looks outward, closed or not."""
    return winding_numbers(surface, points) > 0.5


def nearest_sphere(points: Floats) -> tuple[Floats, float]:
    """Return centre (3,) and radius of the sphere nearest to points (k, 3), by least squares."""
    # |p - c|^2 = radius^2 is linear in c and radius^2 - |c|^2
    system = np.column_stack([2.0 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre, float(np.sqrt(solution[3] + centre @ centre))


def distance_to_path(points: Floats, path: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) to a polyline (k, 3); one point is one, too."""
    starts = path[: max(len(path) - 1, 1)]
    ends = path[min(1, len(path) - 1) :]
    nearest = np.full(len(points), np.inf)
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        part = (points - start) @ along / max(float(along @ along), 1e-12)
        foot = start + np.clip(part, 0.0, 1.0)[:, None] * along
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    return nearest
