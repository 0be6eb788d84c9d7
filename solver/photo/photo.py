"""A photograph as a fit sees it: pixels without distortion, and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from solver.photo.camera import PinholeCamera
from solver.registration.detector import EYE_CORNERS
from solver.registration.landmarks import MEDIAPIPE
from solver.surface import Floats

AROUND = 0.25  # of a face's extent in a photograph, that is looked at around it


@dataclass(frozen=True)
class Photo:
    """A picture, upright and without distortion; places in it are pixels (column, row)."""

    name: str
    pixels: NDArray[np.float32]  # (h, w, 3) sRGB from 0 to 1
    # where it is known; of one that is not placed in the world the rotation is I, the translation 0
    camera: PinholeCamera | None = None
    focal_px: float | None = None  # that the file tells of a picture which was not cropped
    # where landmarks are, (2,) each: by the template's names, or by a number of MediaPipe's mesh
    # (0 to 477, the subject's right eye at 33) written as text
    landmarks: Mapping[str, Floats] = field(default_factory=dict)
    curves: Mapping[str, Floats] = field(default_factory=dict)  # by name, (k, 2) each
    mask: NDArray[np.bool_] | None = None  # (h, w), true where the picture counts
    is_placed: bool = False  # whether the camera's place in the world is known

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height, px."""
        height, width = self.pixels.shape[:2]
        return width, height

    @property
    def eyes_px(self) -> float | None:
        """Return the distance between the outer corners of the eyes; None if one is not marked."""
        right, left = (
            self.landmarks.get(str(number), self.landmarks.get(MEDIAPIPE[number]))
            for number in EYE_CORNERS
        )
        return None if right is None or left is None else float(np.linalg.norm(right - left))


def square_around(places: Floats, photo: Photo) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of a square around places (n, 2), cut to the picture."""
    low = places.min(axis=0)
    high = places.max(axis=0)
    half = (0.5 + AROUND) * float((high - low).max())
    middle = (low + high) / 2.0
    left, top = np.clip(middle - half, 0, np.array(photo.size) - 2).astype(int)
    right, bottom = np.clip(middle + half, (left + 2, top + 2), photo.size).astype(int)
    return int(left), int(top), int(right), int(bottom)
