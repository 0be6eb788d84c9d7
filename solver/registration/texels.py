"""The texels of an image that lie on a skin, by the template's texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.drawing.render import rasterise
from solver.surface import Floats, Ints, Surface, area_normals, faces_within

Value = TypeVar("Value", bound=np.generic)

AROUND = 1.5  # px around a chart that are looked up as well
STEEP = 4.0  # barycentric shares beyond this are of a triangle too thin to go on from


@dataclass(eq=False)
class Texels:
    """The texels (t) of a square image of ``size`` px that lie on a skin."""

    size: int
    rows: Ints  # (t,)
    columns: Ints  # (t,)
    faces: Ints  # (t,) triangles of the skin
    shares: Floats  # (t, 3) of their corners; those around a chart have negative ones
    skin: Surface

    @classmethod
    def of(cls, skin: Surface, coordinates: TextureCoordinates, size: int) -> Texels:
        """Return the texels of all charts as places on the skin.

        Those around a chart lie in the planes of its outermost triangles, so that an image's values
        between texels are right up to a seam.
        """
        places = coordinates.pixels(size)
        flat = np.column_stack([places, np.ones(len(places))])
        mapped = coordinates.mapped
        corners = coordinates.corners[mapped].astype(np.int64)
        seen = rasterise(flat, corners, size, size)
        apart, nearest = distance_transform_edt(~seen.mask, return_indices=True)
        rows, columns = np.nonzero(apart <= AROUND)
        inner = nearest[0][rows, columns], nearest[1][rows, columns]
        triangle = seen.triangle[inner]
        shares = seen.weights[inner].astype(np.float64)
        around = np.flatnonzero(apart[rows, columns] > 0.0)
        middles = np.column_stack([columns, rows])[around].astype(np.float64) + 0.5
        beyond = _plane_shares(middles, places[corners[triangle[around]]])
        shares[around] = np.where(np.abs(beyond).max(axis=1) < STEEP, beyond.T, shares[around].T).T
        return cls(size, rows, columns, mapped[triangle], shares, skin)

    def chosen(self, numbers: Ints) -> Texels:
        """Return some of the texels (c,), by their numbers."""
        rows, columns, faces = (each[numbers] for each in (self.rows, self.columns, self.faces))
        return Texels(self.size, rows, columns, faces, self.shares[numbers], self.skin)

    def at(self, values: Floats, chosen: Ints | slice = slice(None)) -> Floats:
        """Return vertices' ``values`` (v, k) at ``chosen`` texels (c,)."""
        corners = self.skin.faces[self.faces[chosen]]
        return self.blend(values[corners], chosen)

    def blend(self, corners: Floats, chosen: Ints | slice = slice(None)) -> Floats:
        """Return values (c, k) at ``chosen`` texels (c,) by those (c, 3, k) of their corners."""
        return np.asarray(np.einsum("tc,tck->tk", self.shares[chosen], corners))

    def within(self, vertices: Ints) -> Ints:
        """Return the texels (c,) of triangles whose corners are all among ``vertices``."""
        return np.flatnonzero(faces_within(self.skin.faces, vertices)[self.faces])

    def areas(self, chosen: Ints | slice = slice(None)) -> Floats:
        """Return the skin's area (c,) in mm^2 that each of ``chosen`` texels (c,) stands for."""
        faces = self.faces[chosen]
        area = np.linalg.norm(area_normals(self.skin.vertices, self.skin.faces), axis=1) / 2.0
        return np.asarray(area[faces] / np.bincount(faces, minlength=len(area))[faces])

    def image(self, values: NDArray[Value]) -> NDArray[Value]:
        """Return the image (s, s, ...) of values (t, ...), zero beyond the charts."""
        found = np.zeros((self.size, self.size, *values.shape[1:]), values.dtype)
        found[self.rows, self.columns] = values
        return found

    def spread(self, values: NDArray[Value]) -> NDArray[Value]:
        """Return the image (s, s, ...) of values (t, ...); beyond charts those of the nearest."""
        row, column = self._nearest
        found: NDArray[Value] = self.image(values)[row, column]
        return found

    @cached_property
    def _nearest(self) -> NDArray[np.int32]:
        """Row and column (2, s, s) of the texel that is nearest to each place of the image."""
        outside = np.ones((self.size, self.size), bool)
        outside[self.rows, self.columns] = False
        found = distance_transform_edt(outside, return_distances=False, return_indices=True)
        return np.asarray(found, np.int32)


def to_bytes(values: Floats) -> NDArray[np.uint8]:
    """Return values in [0, 1] as an image has them."""
    return np.asarray(np.round(255.0 * np.clip(values, 0.0, 1.0)), np.uint8)


def _plane_shares(points: Floats, triangles: Floats) -> Floats:
    """Return barycentric shares (n, 3) of ``points`` (n, 2) in their ``triangles`` (n, 3, 2)."""
    one = triangles[:, 1] - triangles[:, 0]
    two = triangles[:, 2] - triangles[:, 0]
    own = points - triangles[:, 0]
    with np.errstate(all="ignore"):  # a flat triangle's are not finite
        area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
        second = (own[:, 0] * two[:, 1] - own[:, 1] * two[:, 0]) / area
        third = (one[:, 0] * own[:, 1] - one[:, 1] * own[:, 0]) / area
    return np.column_stack([1.0 - second - third, second, third])
