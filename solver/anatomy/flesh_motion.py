"""How all points of the flesh move when its tetrahedra do."""

from __future__ import annotations

import igl
import numpy as np

from solver.anatomy.domain import boundary
from solver.anatomy.embedding import barycentric
from solver.anatomy.tetrahedra import barycentric_in_tets
from solver.anatomy.warp import Warp
from solver.surface import Floats, Ints, Surface


class FleshMotion:
    """A smooth warp corrected so that it moves a mesh's vertices as they really moved.

    The corrections at the vertices are interpolated in the tetrahedron around a point, or at the
    nearest point of the mesh's boundary. So muscles stay where S has them.
    """

    def __init__(self, vertices: Floats, tets: Ints, moved: Floats, warp: Warp) -> None:
        """Take a mesh, ``vertices`` (p, 3) and ``tets`` (t, 4), and where it ``moved``, (p, 3)."""
        self._vertices, self._tets, self._warp = vertices, tets, warp
        self._surface = Surface(vertices, boundary(tets))
        self._correction = moved - warp(vertices)
        self._tree = igl.AABB()
        self._tree.init(vertices, tets)

    def __call__(self, points: Floats) -> Floats:
        """Return the images (n, 3) of ``points`` (n, 3)."""
        points = np.ascontiguousarray(points)
        tet = np.asarray(igl.in_element(self._vertices, self._tets, points, self._tree))
        correction = np.empty_like(points)
        inside, outside = np.flatnonzero(tet >= 0), np.flatnonzero(tet < 0)
        corners = self._tets[tet[inside]]
        shares = barycentric_in_tets(points[inside], self._vertices[corners])
        correction[inside] = np.einsum("nk,nkd->nd", shares, self._correction[corners])
        if len(outside):
            face, shares, _ = barycentric(points[outside], self._surface)
            corners = self._surface.faces[face]
            correction[outside] = np.einsum("nk,nkd->nd", shares, self._correction[corners])
        return self._warp(points) + correction
