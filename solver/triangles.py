"""What many rooms ask of triangles: their edges, neighbours, normals and areas."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.surface import Floats, Ints


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
