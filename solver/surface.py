"""A triangle surface: the plainest thing that anatomy, scans and pictures share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Surface:
    """Triangles in space: ``vertices`` (n, 3) in mm, ``faces`` (f, 3) vertex numbers."""

    vertices: Floats
    faces: Ints

    def moved(self, vertices: Floats) -> Surface:
        """Return the same triangles with other vertex positions, shape (n, 3)."""
        return Surface(vertices, self.faces)
