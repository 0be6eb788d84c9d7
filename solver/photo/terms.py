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
from solver.surface import Floats, Ints


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
