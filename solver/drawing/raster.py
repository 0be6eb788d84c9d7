"""A small z-buffer: which triangle is seen in each pixel, without a window system or a GPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from solver.surface import Floats, Ints, Surface

Pixels = NDArray[np.float32]


@dataclass(frozen=True)
class Camera:
    """A camera that looks at ``centre`` (3,) from ``distance`` mm.

    ``yaw`` 0 looks at the face from the front, positive from the subject's left; ``pitch`` is
    positive from above (rad). ``span`` is the height in mm that the image shows at the centre.
    """

    centre: Floats
    span: float
    yaw: float = 0.0
    pitch: float = 0.0
    distance: float = 1100.0

    @property
    def axes(self) -> Floats:
        """Return rows right, up and backward (3, 3), unit vectors."""
        sy, cy, sp, cp = np.sin(self.yaw), np.cos(self.yaw), np.sin(self.pitch), np.cos(self.pitch)
        return np.array([[cy, 0.0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]])

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return pixel column, pixel row and depth in mm of points (n, 3)."""
        seen = np.einsum("ij,kj->ik", points - self.centre, self.axes)
        depth = self.distance - seen[:, 2]
        scale = height / self.span * self.distance / depth
        return np.column_stack(
            [width / 2 + seen[:, 0] * scale, height / 2 - seen[:, 1] * scale, depth]
        )


@dataclass(frozen=True)
class Visible:
    """What a camera sees: ``triangle`` (h, w), -1 for nothing, and ``weights`` (h, w, 3)."""

    triangle: NDArray[np.int32]
    weights: Pixels
    faces: Ints

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Return (h, w), true where there is a triangle."""
        return self.triangle >= 0

    def interpolate(self, values: Floats) -> Pixels:
        """Return vertex values (n, k) at the pixels where there is a triangle, (pixels, k)."""
        mask = self.mask
        corners = self.faces[self.triangle[mask]]
        return _blend(values.astype(np.float32), corners, self.weights[mask])


def look(camera: Camera, surface: Surface, width: int, height: int) -> Visible:
    """Return what ``camera`` sees of ``surface`` in an image of width x height pixels."""
    points = camera.project(surface.vertices, width, height)
    triangle, weights = _rasterise(points, surface.faces, width, height)
    return Visible(triangle, weights, surface.faces)


@njit(cache=True)
def _rasterise(
    points: Floats, faces: Ints, width: int, height: int
) -> tuple[NDArray[np.int32], Pixels]:
    """Return the nearest triangle and its perspective-correct weights, per pixel."""
    triangle = np.full((height, width), -1, np.int32)
    weights = np.zeros((height, width, 3), np.float32)
    nearness = np.zeros((height, width), np.float32)
    for face in range(len(faces)):
        ax, ay, az = points[faces[face, 0]]
        bx, by, bz = points[faces[face, 1]]
        cx, cy, cz = points[faces[face, 2]]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0 or min(az, bz, cz) <= 0.0:
            continue
        left = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
        right = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        top = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
        bottom = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                a = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                b = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                near = a / az + b / bz + c / cz
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    triangle[row, column] = face
                    weights[row, column, 0] = a / az / near
                    weights[row, column, 1] = b / bz / near
                    weights[row, column, 2] = c / cz / near
    return triangle, weights


@njit(cache=True)
def _blend(values: Pixels, corners: Ints, weights: Pixels) -> Pixels:
    blended = np.empty((len(corners), values.shape[1]), np.float32)
    for pixel in range(len(corners)):
        a, b, c = corners[pixel]
        for column in range(values.shape[1]):
            blended[pixel, column] = (
                weights[pixel, 0] * values[a, column]
                + weights[pixel, 1] * values[b, column]
                + weights[pixel, 2] * values[c, column]
            )
    return blended
