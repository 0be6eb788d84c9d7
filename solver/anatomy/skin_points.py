"""Points fixed on a template's skin, such as those a detector of landmarks finds in pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from solver.storage import Arrays
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class SkinPoints:
    """Named points inside triangles of the skin."""

    names: tuple[str, ...]  # (k,) of a detector: its numbers, 0 to 467, written as text
    corners: Ints  # (k, 3) vertices of the skin
    weights: Floats  # (k, 3) of the corners, which sum to 1
    spread_mm: Floats  # (k,) root mean square distance of what was measured of each

    def at(self, skin: Floats) -> Floats:
        """Return where the points (k, 3) are on a skin (V, 3)."""
        return np.asarray(np.einsum("ki,kij->kj", self.weights, skin[self.corners]))

    def has(self, name: str) -> bool:
        """Return whether there is a point of this name."""
        return name in self._rows

    def select(self, names: list[str]) -> SkinPoints:
        """Return those of the points that have these names, in their order."""
        rows = [self._rows[name] for name in names]
        return SkinPoints(
            tuple(names), self.corners[rows], self.weights[rows], self.spread_mm[rows]
        )

    def arrays(self) -> Arrays:
        """Return the points as named arrays, for a file."""
        return {
            "names": np.array(self.names, dtype=np.str_),
            "corners": self.corners,
            "weights": self.weights,
            "spread_mm": self.spread_mm,
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> SkinPoints:
        """Return the points that :meth:`arrays` described."""
        plain = {name: arrays[name] for name in ("corners", "weights", "spread_mm")}
        return cls(tuple(str(name) for name in arrays["names"].ravel()), **plain)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.names)}
