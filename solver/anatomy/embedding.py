"""How skin vertices follow the flesh: in the tetrahedron under the nearest outer triangle."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.surface import Floats, Ints, Surface

LEAST_SHARE = -1.5
"""A vertex may lie this far outside its tetrahedron, as a part of its height: skin crosses over
where nostrils meet, and then lies behind the tets it covers."""


def barycentric(points: Floats, surface: Surface) -> tuple[Ints, Floats, Floats]:
    """Return the nearest triangles (n,), the shares (n, 3) in them and the distance (n,)."""
    points = np.ascontiguousarray(points)
    squared, face, closest = igl.point_mesh_squared_distance(
        points, surface.vertices, surface.faces
    )
    corners = surface.faces[face]
    a, b, c = (np.ascontiguousarray(surface.vertices[corners[:, k]]) for k in range(3))
    shares = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(closest), a, b, c))
    return np.asarray(face), shares, np.sqrt(np.asarray(squared))


def rows_of(corners: Ints, shares: Floats, count: int) -> sp.csr_array:
    """Return CSR rows (n, count) with ``shares`` (n, k) in the columns ``corners`` (n, k)."""
    indptr = np.arange(0, corners.size + 1, corners.shape[1])
    parts = (shares.ravel(), corners.ravel(), indptr)
    rows = sp.csr_array(parts, shape=(len(corners), count), copy=True)
    rows.sort_indices()
    return rows


def shares_in_tets(points: Floats, vertices: Floats, corners: Ints, inside: Floats) -> Floats:
    """Return barycentric coordinates (n, 4) of points in given tetrahedra, bounded.

    Parameters
    ----------
    points
        (n, 3) points in or near their tetrahedra.
    vertices
        (p, 3) vertices of the mesh.
    corners
        (n, 4) corners of the tetrahedron of each point.
    inside
        (n, 4) coordinates of a point in or on that tetrahedron. Where the point's own have one
        below :data:`LEAST_SHARE` they are drawn towards these: what is missed is an offset.
    """
    exact = barycentric_in_tets(points, vertices[corners])
    room = (inside - LEAST_SHARE) / np.maximum(inside - exact, 1e-12)
    part = np.minimum(np.where(exact < inside, room, 1.0).min(axis=1), 1.0)[:, None]
    return np.asarray(part * exact + (1.0 - part) * inside)
