"""Triangles that registration has turned over, and laying them flat again."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from solver.normals import vertex_normals
from solver.surface import Floats, Ints, Surface
from solver.triangles import adjacency, area_normals

WIDENINGS = 10
SHORTEST_MM = 0.05


def folded_triangles(before: Floats, after: Floats, faces: Ints) -> Ints:
    """Return the numbers of the faces (f, 3) that oppose the skin around them, but did not before.

    A triangle opposes the skin where its normal points away from the mean of its vertices'
    normals. ``before`` and ``after`` are vertices (n, 3).
    """
    return np.flatnonzero((_agreement(after, faces) < 0) & (_agreement(before, faces) >= 0))


def unfolded(before: Floats, after: Floats, faces: Ints) -> Floats:
    """Return ``after`` (n, 3) without its triangles turned over against ``before`` (n, 3).

    Around every fold the displacement from ``before`` is laid anew, with the least bending that
    fits the skin beside it; its patch grows ring by ring until the fold is gone. What is still
    folded after :data:`WIDENINGS` rings stays.
    """
    graph = adjacency(faces, len(before))
    bending = _bending(before, graph)
    inside = np.zeros(0, dtype=np.int64)
    for rings in range(1, WIDENINGS + 1):
        folds = folded_triangles(before, after, faces)
        if not len(folds):
            break
        patch = np.zeros(len(before))
        patch[faces[folds]] = 1.0
        for _ in range(rings):
            patch = graph @ patch + patch
        inside = np.union1d(inside, np.flatnonzero(patch))
        outside = np.setdiff1d(np.arange(len(before)), inside)
        displacement = after - before
        rows = bending[inside]
        matrix = sp.csc_array(rows[:, inside] + 1e-9 * sp.eye_array(len(inside)))
        laid = spsolve(matrix, -(rows[:, outside] @ displacement[outside]))
        after = after.copy()
        after[inside] = before[inside] + laid
    return after


def _bending(vertices: Floats, graph: sp.csr_array) -> sp.csr_array:
    """Return the squared Laplacian with weights 1 / length^2: close vertices move alike."""
    edges = sp.coo_array(graph)
    squared = np.sum((vertices[edges.row] - vertices[edges.col]) ** 2, axis=1)
    weights = sp.csr_array(
        (1 / (squared + SHORTEST_MM**2), (edges.row, edges.col)), shape=graph.shape
    )
    laplacian = sp.csr_array(sp.diags_array(weights.sum(axis=1)) - weights)
    return sp.csr_array(laplacian @ laplacian)


def _agreement(vertices: Floats, faces: Ints) -> Floats:
    normal = area_normals(vertices, faces)
    around = vertex_normals(Surface(vertices, faces))[faces].mean(axis=1)
    return np.asarray(np.einsum("nd,nd->n", normal, around))
