"""Terms of a photograph: residuals of the skin's points in a picture, in units of their noise.

    f(skin, camera) = sum_i rho(r_i),    rho(r) = s^2 (sqrt(1 + r^2 / s^2) - 1)

rho is the pseudo-Huber loss: r^2 / 2 for small residuals, s |r| for those of points that a hand or
hair hides. Being in units of noise, terms of pictures of any size add up with one set of prices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.anatomy.skin_points import SkinPoints
from solver.photo.camera import PinholeCamera
from solver.surface import Floats, Ints, unit_rows


@dataclass(frozen=True)
class LinearResidual:
    """Residuals (m,) and their derivatives by the skin (m, 3 V) and by the camera (m, 7)."""

    residual: Floats
    by_skin: sp.csr_array
    by_camera: Floats


class ImageTerm(Protocol):
    """What a picture says about the skin (V, 3) and the camera that took it."""

    def residual(self, skin: Floats, camera: PinholeCamera) -> Floats:
        """Return the residuals (m,) in units of their noise."""

    def linearise(self, skin: Floats, camera: PinholeCamera) -> LinearResidual:
        """Return them with their derivatives."""


@dataclass(frozen=True)
class PseudoHuber:
    """The loss rho: of the residual itself up to about ``scale`` units of noise."""

    scale: float = 2.0

    def value(self, residual: Floats) -> float:
        """Return the sum of rho."""
        grown = np.sqrt(1.0 + (residual / self.scale) ** 2)
        return float(self.scale**2 * (grown - 1.0).sum())

    def weights(self, residual: Floats) -> Floats:
        """Return rho'(r) / r (m,): what a residual counts as in a step of least squares."""
        return np.asarray(1.0 / np.sqrt(1.0 + (residual / self.scale) ** 2))


@dataclass(frozen=True)
class LandmarkTerm(ImageTerm):
    """Points of the skin and where a picture has them."""

    points: SkinPoints
    pixels: Floats  # (k, 2) where the picture has them
    noise_px: Floats  # (k,) standard deviation of each coordinate

    def residual(self, skin: Floats, camera: PinholeCamera) -> Floats:
        """See :class:`ImageTerm`: (2 k,), a column and a row for each point."""
        found = camera.project(self.points.at(skin))[:, :2]
        return np.asarray(((found - self.pixels) / self.noise_px[:, None]).ravel())

    def linearise(self, skin: Floats, camera: PinholeCamera) -> LinearResidual:
        """See :class:`ImageTerm`."""
        by_point, by_camera = camera.derivatives(self.points.at(skin))
        scale = 1.0 / self.noise_px[:, None, None]
        by_skin = by_vertices(scale * by_point, self.points.corners, self.points.weights, len(skin))
        by_seven = (scale * by_camera).reshape(-1, by_camera.shape[2])
        return LinearResidual(self.residual(skin, camera), by_skin, by_seven)


@dataclass(frozen=True)
class CurveTerm(ImageTerm):
    """A closed line of the skin and places on its image, such as a lip's border that was traced.

    A place (k, 2) counts by its distance to the line alone: where along it, nobody knows.
    """

    line: SkinPoints  # in their order
    pixels: Floats  # (k, 2)
    noise_px: float

    def residual(self, skin: Floats, camera: PinholeCamera) -> Floats:
        """See :class:`ImageTerm`: (k,)."""
        return self._nearest(camera.project(self.line.at(skin))[:, :2]).away / self.noise_px

    def linearise(self, skin: Floats, camera: PinholeCamera) -> LinearResidual:
        """See :class:`ImageTerm`; as a place slides along the line its distance stays."""
        points = self.line.at(skin)
        near = self._nearest(camera.project(points)[:, :2])
        by_point, by_camera = camera.derivatives(points)
        ends = np.column_stack([near.segment, (near.segment + 1) % len(points)])
        shares = np.column_stack([1.0 - near.part, near.part]) / self.noise_px
        pulled = np.einsum("ki,ks,ksij->ksj", near.direction, shares, by_point[ends])
        by_seven = np.einsum("ki,ks,ksij->kj", near.direction, shares, by_camera[ends])
        count = len(skin)
        halves = [
            by_vertices(
                pulled[:, side, None], self.line.corners[each], self.line.weights[each], count
            )
            for side, each in enumerate(ends.T)
        ]
        return LinearResidual(near.away / self.noise_px, halves[0] + halves[1], by_seven)

    def _nearest(self, line: Floats) -> _Nearest:
        """Return where a closed line (n, 2) is nearest to each place."""
        along = np.roll(line, -1, axis=0) - line
        from_start = self.pixels[:, None] - line
        length = np.maximum((along**2).sum(axis=1), 1e-12)
        part = np.clip(np.einsum("kni,ni->kn", from_start, along) / length, 0.0, 1.0)
        offset = part[..., None] * along - from_start  # from the place to the line
        rows = np.arange(len(self.pixels))
        segment = np.linalg.norm(offset, axis=2).argmin(axis=1)
        found = offset[rows, segment]
        away = np.linalg.norm(found, axis=1)
        across = unit_rows(along[segment][:, ::-1] * [1.0, -1.0])
        is_off = (away > 1e-9)[:, None]
        direction = np.where(is_off, found / np.maximum(away, 1e-9)[:, None], across)
        return _Nearest(segment, part[rows, segment], away, direction)


@dataclass(frozen=True)
class _Nearest:
    """Where a line is nearest to places: part (k,) of a segment (k,), and which way from them."""

    segment: Ints
    part: Floats
    away: Floats
    direction: Floats  # (k, 2) unit vectors


def by_vertices(by_point: Floats, corners: Ints, weights: Floats, count: int) -> sp.csr_array:
    """Return derivatives (d k, 3 count) by vertices of those by points in triangles (k, d, 3).

    Points are ``weights`` (k, 3) of their ``corners`` (k, 3).
    """
    size = by_point.shape[1]
    entries = np.einsum("kdi,kc->kdci", by_point, weights)
    columns = np.broadcast_to(
        (3 * corners[:, :, None] + np.arange(3))[:, None], entries.shape
    ).reshape(len(corners) * size, -1)
    starts = np.arange(0, columns.size + 1, columns.shape[1])
    shape = (len(corners) * size, 3 * count)
    return sp.csr_array((entries.ravel(), columns.ravel(), starts), shape=shape)
