"""Landmarks that a detector would find in a film of a face that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.skin_points import SkinPoints
from solver.live.landmarks import COUNT, IMAGE_AXES
from solver.photo.camera import PinholeCamera
from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class FilmOptions:
    """A telephone's camera, and how well the detector sees; lengths in mm and px."""

    distance_mm: float = 450.0  # of the camera from the middle of the face
    focal_px: float = 900.0
    noise_px: float = 0.5
    depth_noise_px: float = 4.0  # which a detector guesses


class FilmedLandmarks:
    """Sees a face about ``middle`` (3,) by the ``points`` of its template, with white noise."""

    def __init__(
        self, points: SkinPoints, middle: Floats, options: FilmOptions = FilmOptions()
    ) -> None:
        self._points = points.detected()
        self._rows = [int(name) for name in self._points.names]
        self._options = options
        self._rng = np.random.default_rng(3)
        shift = np.array([0.0, 0.0, options.distance_mm]) - IMAGE_AXES @ middle
        focal = np.full(2, options.focal_px)
        self._camera = PinholeCamera(focal, np.array([640.0, 360.0]), IMAGE_AXES, shift)

    def seen(self, skin: Floats, head: Similarity) -> NDArray[np.float32]:
        """Return the landmarks (478, 3) of a skin (V, 3) whose head has moved, NaN without any."""
        options = self._options
        seen = self._camera.project(head(self._points.of(skin)))
        depth = float(np.median(seen[:, 2]))
        seen[:, 2] = (seen[:, 2] - depth) * options.focal_px / depth
        noise = np.array([options.noise_px, options.noise_px, options.depth_noise_px])
        seen += noise * self._rng.standard_normal(seen.shape)
        found = np.full((COUNT, 3), np.nan, np.float32)
        found[self._rows] = seen
        return found
