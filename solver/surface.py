"""A triangle surface: the plainest thing that anatomy, scans and pictures share."""

from __future__ import annotations

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

    def moved(self, vertices: Floats) -> Surface:
        """Return the same triangles with other vertex positions, shape (n, 3)."""
        return Surface(vertices, self.faces)


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


def vertex_areas(vertices: Floats, faces: Ints) -> Floats:
    """Return the area (n,) that belongs to each vertex: a third of its triangles'."""
    area = np.linalg.norm(area_normals(vertices, faces), axis=1) / 6
    sums = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices))
    return np.asarray(sums, np.float64)
