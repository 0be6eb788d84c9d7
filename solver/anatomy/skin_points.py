"""Points fixed on a template's skin, such as those a detector of landmarks finds in pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from solver.storage import Arrays
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class SkinSamples:
    """Points inside triangles of the skin."""

    corners: Ints  # (k, 3) vertices of the skin
    weights: Floats  # (k, 3) of the corners, which sum to 1

    def of(self, values: Floats) -> Floats:
        """Return vertex values (V, d) at the points (k, d)."""
        return np.asarray(np.einsum("nk,nkd->nd", self.weights, values[self.corners]))

    def matrix(self, count: int) -> sp.csr_array:
        """Return the weights (k, V) of all ``count`` vertices of a skin."""
        rows = np.repeat(np.arange(len(self.corners)), 3)
        entries = self.weights.ravel(), (rows, self.corners.ravel())
        return sp.csr_array(entries, shape=(len(self.corners), count))


@dataclass(frozen=True)
class SkinPoints(SkinSamples):
    """Named points of the skin."""

    names: tuple[str, ...]  # (k,) of a detector: its numbers, 0 to 467, written as text
    spread_mm: Floats  # (k,) root mean square distance of what was measured of each
    # (k, 3) mm from each to where it is marked on one person; None: they are as they are
    offsets: Floats | None = None

    def at(self, skin: Floats) -> Floats:
        """Return where the points (k, 3) are on a skin (V, 3), offsets included."""
        return self.of(skin) if self.offsets is None else self.of(skin) + self.offsets

    def has(self, name: str) -> bool:
        """Return whether there is a point of this name."""
        return name in self._rows

    def detected(self) -> SkinPoints:
        """Return the points that a detector finds: those named by its numbers."""
        return self.select([name for name in self.names if name.isdecimal()])

    def select(self, names: list[str]) -> SkinPoints:
        """Return the points of these names, in their order."""
        rows = [self._rows[name] for name in names]
        offsets = None if self.offsets is None else self.offsets[rows]
        samples = (self.corners[rows], self.weights[rows])
        spread = self.spread_mm[rows]
        return SkinPoints(*samples, tuple(names), spread, offsets)

    def moved(self, offsets: Mapping[str, Floats]) -> SkinPoints:
        """Return the points with ``offsets`` (3,), mm, of those that have these names."""
        own = np.zeros((len(self.names), 3))
        for name, offset in offsets.items():
            own[self._rows[name]] = offset
        return replace(self, offsets=own)

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
        return cls(names=tuple(str(name) for name in arrays["names"].ravel()), **plain)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.names)}
