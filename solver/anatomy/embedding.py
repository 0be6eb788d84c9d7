"""How points follow a surface: barycentric in the nearest triangle."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp

from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class Embedding:
    """Rows (n, p) of barycentric weights and the ``distance`` (n,) in mm of what they miss."""

    rows: sp.csr_array
    distance: Floats


def embed(points: Floats, vertices: Floats, faces: Ints) -> Embedding:
    """Bind ``points`` (n, 3) to the nearest point of the flesh's outer ``faces`` (f, 3).

    The surface is used rather than the tetrahedra behind it: it follows the skin closely, and
    what is missed becomes a constant offset.
    """
    corners, shares, distance = barycentric(points, Surface(vertices, faces))
    numbers = np.repeat(np.arange(len(points)), 3)
    rows = sp.csr_array(
        (shares.ravel(), (numbers, corners.ravel())), shape=(len(points), len(vertices))
    )
    return Embedding(rows, distance)


def barycentric(points: Floats, surface: Surface) -> tuple[Ints, Floats, Floats]:
    """Return the nearest triangles' corners (n, 3), the shares (n, 3) and the distance (n,)."""
    points = np.ascontiguousarray(points)
    squared, face, closest = igl.point_mesh_squared_distance(
        points, surface.vertices, surface.faces
    )
    corners = surface.faces[face]
    a, b, c = (np.ascontiguousarray(surface.vertices[corners[:, k]]) for k in range(3))
    shares = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(closest), a, b, c))
    return corners, shares, np.sqrt(np.asarray(squared))
