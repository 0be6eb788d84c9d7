"""Triangles that registration has turned over, and laying them flat again."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from solver.registration.neighbours import adjacency
from solver.rig.normals import vertex_normals
from solver.surface import Floats, Ints, Surface

WIDENINGS = 10


def folded_triangles(before: Floats, after: Floats, faces: Ints) -> Ints:
    """Return the numbers of the faces (f, 3) that oppose the skin around them, but did not before.

    A triangle opposes the skin where its normal points away from the mean of its vertices'
    normals. ``before`` and ``after`` are vertices (n, 3).
    """
    return np.flatnonzero((_agreement(after, faces) < 0) & (_agreement(before, faces) >= 0))


def unfolded(before: Floats, after: Floats, faces: Ints) -> Floats:
    """Return ``after`` (n, 3) with no triangle turned over against ``before`` (n, 3).

    Around every fold the displacement from ``before`` is laid anew, with the least bending that
    fits the skin beside it; the patch grows ring by ring until the fold is gone.
    """
    graph = adjacency(faces, len(before))
    laplacian = sp.csr_array(sp.diags_array(graph.sum(axis=1)) - graph)
    bending = sp.csr_array(laplacian @ laplacian)
    patch = np.zeros(len(before))
    for _ in range(WIDENINGS):
        folds = folded_triangles(before, after, faces)
        if not len(folds):
            break
        patch[faces[folds]] = 1.0
        patch += graph @ patch
        inside, outside = np.flatnonzero(patch), np.flatnonzero(patch == 0)
        displacement = after - before
        rows = bending[inside]
        matrix = sp.csc_array(rows[:, inside] + 1e-9 * sp.eye_array(len(inside)))
        laid = spsolve(matrix, -(rows[:, outside] @ displacement[outside]))
        after = after.copy()
        after[inside] = before[inside] + laid
    return after


def _agreement(vertices: Floats, faces: Ints) -> Floats:
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = vertex_normals(Surface(vertices, faces))[faces].mean(axis=1)
    return np.asarray(np.einsum("nd,nd->n", normal, around))
