"""How any points in and about the flesh follow its tets."""

from __future__ import annotations

import igl
import numpy as np

from solver.anatomy.embedding import barycentric
from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.surface import Floats, Ints, Surface

OPPOSITE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The face of a tet opposite each of its corners."""


def bind(points: Floats, vertices: Floats, tets: Ints) -> tuple[Ints, Floats]:
    """Return the tet (n,) that each point (n, 3) follows and its barycentric weights (n, 4).

    A point moves by the weighted mean of its tet's corners' displacements. One outside the mesh,
    where many a muscle begins, moves as the nearest point of the mesh does: the weights are that
    one's.
    """
    tree = igl.AABB()
    tree.init(vertices, tets)
    tet = np.array(igl.in_element(vertices, tets, points, tree), np.int64)
    weights = np.empty((len(points), 4))
    inside, outside = np.flatnonzero(tet >= 0), np.flatnonzero(tet < 0)
    weights[inside] = barycentric_in_tets(points[inside], vertices[tets[tet[inside]]])
    if len(outside):
        faces, owners = _outer_faces(tets)
        nearest, shares, _ = barycentric(points[outside], Surface(vertices, faces))
        tet[outside] = owners[nearest]
        same = tets[owners[nearest]][:, :, None] == faces[nearest][:, None, :]
        weights[outside] = np.einsum("nck,nk->nc", same, shares)
    return tet, weights


def _outer_faces(tets: Ints) -> tuple[Ints, Ints]:
    """Return the faces (f, 3) that belong to one tet only, and that tet's number (f,)."""
    faces = np.sort(tets[:, OPPOSITE].reshape(-1, 3), axis=1)
    unique, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    outer = count == 1
    return unique[outer], first[outer] // len(OPPOSITE)
