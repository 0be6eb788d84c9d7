"""How skin vertices follow the flesh: barycentric in a tetrahedron, or at its nearest surface."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp

from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Embedding:
    """Rows (n, p) of barycentric weights and the ``distance`` (n,) in mm of what they miss."""

    rows: sp.csr_array
    distance: Floats


def embed(points: Floats, vertices: Floats, faces: Ints) -> Embedding:
    """Bind ``points`` (n, 3) to the nearest point of the flesh's outer ``faces`` (f, 3).

    The surface is used rather than the tetrahedra behind it: it follows the skin to the mesher's
    envelope, and what is missed becomes a constant offset.
    """
    squared, face, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    corners = faces[face]
    a, b, c = (np.ascontiguousarray(vertices[corners[:, k]]) for k in range(3))
    weights = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(closest), a, b, c))
    numbers = np.repeat(np.arange(len(points)), 3)
    rows = sp.csr_array(
        (weights.ravel(), (numbers, corners.ravel())), shape=(len(points), len(vertices))
    )
    return Embedding(rows, np.sqrt(np.asarray(squared)))
