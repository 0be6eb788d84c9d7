"""A reduced skin: rest and modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.surface import Floats


@dataclass(frozen=True, eq=False)
class SkinModes:
    """A skin at ``rest`` (v, 3) in mm, and ``modes`` (r, 3 v) of its motion.

    A coordinate of 1 moves the skin by 1 mm, in root mean squares; modes are orthogonal.
    """

    rest: NDArray[np.float32]
    modes: NDArray[np.float32]

    @classmethod
    def of(cls, rest: Floats, skins: NDArray[np.floating], count: int) -> SkinModes:
        """Return the main modes of ``skins`` (n, v, 3), at most ``count``."""
        moved = (skins - rest).reshape(len(skins), -1)
        values, vectors = np.linalg.eigh(np.asarray(moved @ moved.T, np.float64))
        main = np.flatnonzero(values > 1e-9 * values[-1])[-count:][::-1]
        modes = (vectors[:, main] * np.sqrt(len(rest) / values[main])).T @ moved
        return cls(rest.astype(np.float32), np.asarray(modes, np.float32))

    def reduce(self, skin: Floats) -> Floats:
        """Return the coordinates (r,) of a skin (v, 3)."""
        moved = (skin - self.rest).ravel()
        return np.asarray(self.modes @ moved, np.float64) / len(self.rest)

    def expand(self, coordinates: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the skin (..., v, 3) of coordinates (..., r)."""
        moved = coordinates.astype(np.float32) @ self.modes
        return np.asarray(self.rest + moved.reshape(*coordinates.shape[:-1], -1, 3))
