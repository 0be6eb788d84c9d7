"""A pinhole camera with lens distortion, as OpenCV has it, and its derivatives.

A point X of the world (mm) is Y = R X + t for the camera, x right, y down, z into the picture; its
pixel is (fx Y_x / Y_z + c_x, fy Y_y / Y_z + c_y), the middle of the first pixel being (0.5, 0.5).
Distortion (Brown 1971: k1, k2, p1, p2, k3) is taken out of a picture and of what was marked in it
once, when they are read, so that everything after is a pinhole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from solver.similarity import Similarity
from solver.surface import Floats, skew

# of a camera's six numbers: a turn (rotation vector, about the camera's axes) and a shift, mm
POSE_FREEDOM = 6
# a seventh: the logarithm of its focal length
CAMERA_FREEDOM = POSE_FREEDOM + 1


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without distortion."""

    focal: Floats  # (2,) fx and fy, px
    centre: Floats  # (2,) principal point, px
    rotation: Floats  # (3, 3) of the world into the camera's axes
    translation: Floats  # (3,) mm

    @property
    def yaw(self) -> float:
        """Return how far a face in the world's frame is turned aside from it, rad, to any side."""
        right, _, away = self.rotation[:, 2]
        return float(np.arctan2(abs(right), -away))

    def project(self, points: Floats) -> Floats:
        """Return pixel column, pixel row and depth in mm (n, 3) of points (n, 3) of the world."""
        seen = points @ self.rotation.T + self.translation
        pixels = self.focal * seen[:, :2] / seen[:, 2:] + self.centre
        return np.column_stack([pixels, seen[:, 2]])

    def derivatives(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of pixels by each point (n, 2, 3), and by the camera (n, 2, 7).

        The camera's seven are those of :meth:`moved`.
        """
        turned = points @ self.rotation.T
        seen = turned + self.translation
        by_seen = np.zeros((len(points), 2, 3))
        by_seen[:, 0, 0], by_seen[:, 1, 1] = (self.focal / seen[:, 2:]).T
        by_seen[:, :, 2] = -self.focal * seen[:, :2] / seen[:, 2:] ** 2
        by_camera = np.empty((len(points), 2, CAMERA_FREEDOM))
        # a small turn w moves R X by w x R X
        by_camera[:, :, :3] = np.cross(turned[:, None], by_seen)
        by_camera[:, :, 3:6] = by_seen
        by_camera[:, :, 6] = self.focal * seen[:, :2] / seen[:, 2:]
        return by_seen @ self.rotation, by_camera

    def moved(self, change: Floats) -> PinholeCamera:
        """Return the camera after a ``change`` (7,): turn, rad; shift, mm; log of the focal length.

        The turn is about the camera's axes, on top of its rotation.
        """
        turn = Rotation.from_rotvec(change[:3]).as_matrix()
        return replace(
            self,
            focal=self.focal * np.exp(change[6]),
            rotation=turn @ self.rotation,
            translation=self.translation + change[3:6],
        )

    def with_head(self, head: Similarity) -> PinholeCamera:
        """Return the camera of a head's own frame, which ``head`` (scale 1) takes to the world."""
        return replace(
            self,
            rotation=self.rotation @ head.rotation,
            translation=self.rotation @ head.shift + self.translation,
        )

    def head_of(self, other: PinholeCamera) -> Similarity:
        """Return the head that makes this camera of the world the ``other``, of its own frame."""
        turn = self.rotation.T
        return Similarity(1.0, turn @ other.rotation, turn @ (other.translation - self.translation))

    def head_rates(self, head: Similarity) -> Floats:
        """Return the change (7, 6) of :meth:`with_head` by a small motion of the head.

        A rotation vector and a shift, mm, in the world.
        """
        rates = np.zeros((CAMERA_FREEDOM, POSE_FREEDOM))
        rates[:3, :3] = rates[3:6, 3:] = self.rotation
        rates[3:6, :3] = -skew(self.rotation @ head.shift) @ self.rotation
        return rates

    def scaled(self, factor: float) -> PinholeCamera:
        """Return the camera of a picture that is ``factor`` times as large."""
        return replace(self, focal=factor * self.focal, centre=factor * self.centre)


@dataclass(frozen=True)
class Lens:
    """Distortion (5,) k1, k2, p1, p2, k3 of pictures by a focal length and a centre (2,), px."""

    focal: Floats
    centre: Floats
    distortion: Floats

    def distort(self, pixels: Floats) -> Floats:
        """Return where a distorted picture has the pixels (n, 2) of a pinhole's."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ((pixels - self.centre) / self.focal).T
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        across = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        down = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.column_stack([across, down]) * self.focal + self.centre

    def undistort(self, pixels: Floats, rounds: int = 20) -> Floats:
        """Return where a pinhole has the pixels (n, 2) of a distorted picture (fixed point)."""
        found = pixels.copy()
        for _ in range(rounds):
            found += pixels - self.distort(found)
        return found
