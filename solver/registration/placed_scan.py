"""A scan of any fineness laid on its registered skin, asked for the place that shows a point."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

from solver.meshio.mesh import weld
from solver.surface import (
    Floats,
    Ints,
    Surface,
    area_normals,
    directed_edges,
    edge_keys,
    vertex_normals,
)


@dataclass(frozen=True)
class ScanTrust:
    """Limits up to which points of a scan are trusted; lengths in mm."""

    farthest: float = 8.0  # a place of the scan farther off is none of this skin
    trusted: float = 3.0  # distance at which confidence has fallen to 1/e
    least_cosine: float = 0.3  # of the normals
    surest_cosine: float = 0.8  # from which on the angle costs nothing
    border: float = 3.0  # to the scan's edge, within which confidence fades to nothing


TRUST = ScanTrust()


@dataclass(frozen=True, eq=False)
class Shown:
    """A scan's values at n places of a skin."""

    faces: Ints  # (n,) the scan's triangles
    shares: Floats  # (n, 3) of their corners
    places: Floats  # (n, 3) mm
    normals: Floats  # (n, 3) outward, not of length 1
    confidence: Floats  # (n,) from 0, not seen, to 1


class PlacedScan:
    """A scan's surface, its vertices (n, 3) on the ``skin``; the ``face`` (k,) tells its outside.

    Vertices that are not finite and triangles without area are left out.
    """

    def __init__(self, scan: Surface, skin: Surface, face: Ints, trust: ScanTrust = TRUST) -> None:
        vertices = scan.vertices
        finite = np.asarray(np.isfinite(vertices).all(axis=1))
        doubled = np.linalg.norm(area_normals(np.nan_to_num(vertices), scan.faces), axis=1)
        whole = np.asarray(finite[scan.faces].all(axis=1))
        self._trust = trust
        self._numbers = np.flatnonzero(whole & (doubled > 0.0))
        self._vertices = np.ascontiguousarray(np.where(finite[:, None], vertices, 0.0))
        self._faces = np.ascontiguousarray(scan.faces[self._numbers])
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        first, place = weld(self._vertices)  # vertices that are there twice for their colours' sake
        joined = place[self._faces]
        smooth = vertex_normals(Surface(self._vertices[first], joined))
        self._normals = smooth[place]
        _, edge, counts = np.unique(
            edge_keys(joined, directed=False), return_index=True, return_counts=True
        )
        rim = np.unique(directed_edges(joined)[edge[counts == 1]])
        self._rim = cKDTree(self._vertices[first][rim]) if len(rim) else None
        _, near, shares, _ = self._closest(skin.vertices[face])
        cosines = np.einsum("nd,nd->n", self._normal(near, shares), vertex_normals(skin)[face])
        if cosines.sum() < 0.0:  # it is wound inward
            self._normals = -self._normals

    def _closest(self, points: Floats) -> tuple[Floats, Ints, Floats, Floats]:
        """Return distance, triangle, barycentric shares and place of the closest places."""
        squared, face, near = self._tree.squared_distance(self._vertices, self._faces, points)
        corners = self._vertices[self._faces[face]].swapaxes(0, 1)
        shares = igl.barycentric_coordinates(near, *map(np.ascontiguousarray, corners))
        shares = np.clip(np.nan_to_num(shares), 0.0, 1.0)
        return np.sqrt(squared), face, shares, near

    def _normal(self, face: Ints, shares: Floats) -> Floats:
        return np.asarray(np.einsum("nc,ncd->nd", shares, self._normals[self._faces[face]]))

    def look_up(self, points: Floats, normals: Floats) -> Shown:
        """Return the closest places to ``points`` (n, 3) of a skin with these normals (n, 3)."""
        trust = self._trust
        distance, face, shares, near = self._closest(points)
        own = self._normal(face, shares)
        cosine = np.einsum("nd,nd->n", own, normals)
        span = trust.surest_cosine - trust.least_cosine
        confidence = np.exp(-((distance / trust.trusted) ** 2))
        confidence *= np.clip((cosine - trust.least_cosine) / span, 0.0, 1.0)
        if self._rim is not None:
            to_rim = self._rim.query(near, distance_upper_bound=trust.border)[0]  # inf beyond
            confidence *= np.minimum(to_rim / trust.border, 1.0)
        confidence[distance > trust.farthest] = 0.0
        return Shown(self._numbers[face], shares, near, own, confidence)
