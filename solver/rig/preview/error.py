"""How far the reduced skin is off the simulated one, on poses it was not made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.rig.preview.basis import ReducedSkin
from solver.rig.preview.samples import Sample
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Distances:
    """Distances in mm of the face's vertices over a number of ``poses``.

    ``moved`` is how far the simulated skin is from the neutral on average.
    """

    poses: int
    moved: float
    mean: float
    p95: float
    max: float

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as JSON values, with four decimals."""
        figures = {"moved": self.moved, "mean": self.mean, "p95": self.p95, "max": self.max}
        return {name: round(value, 4) for name, value in figures.items()} | {"poses": self.poses}


class PreviewError:
    """The distances of ``samples`` on the ``face`` (k,) vertices of the ``neutral`` skin (n, 3).

    ``off`` (s, k) are all of them, in mm.
    """

    def __init__(
        self, skin: ReducedSkin, samples: Sequence[Sample], neutral: Floats, face: Ints
    ) -> None:
        self.samples = samples
        self.off: Floats = np.empty((len(samples), len(face)))
        self._moved = np.empty_like(self.off)
        for row, sample in enumerate(samples):
            motion = (sample.skin - neutral)[face]
            away = skin.motion(sample.slid.values)[face] - motion
            self.off[row] = np.linalg.norm(away, axis=1)
            self._moved[row] = np.linalg.norm(motion, axis=1)

    @property
    def overall(self) -> Distances:
        """Return the distances of all samples, of which there has to be one."""
        return self._over(np.arange(len(self.samples)))

    def of_sorts(self) -> dict[str, Distances]:
        """Return the distances of every sort of pose."""
        sorts = np.array([sample.slid.sort for sample in self.samples])
        return {
            sort: self._over(np.flatnonzero(sorts == sort))
            for sort in dict.fromkeys(sorts.tolist())
        }

    def mean_about(self, name: str) -> float | None:
        """Return the mean distance, mm, of the poses about a control or an expression."""
        rows = [row for row, sample in enumerate(self.samples) if sample.slid.about == name]
        return round(float(self.off[rows].mean()), 4) if rows else None

    def _over(self, rows: Ints) -> Distances:
        off = self.off[rows]
        return Distances(
            len(rows),
            float(self._moved[rows].mean()),
            float(off.mean()),
            float(np.percentile(off, 95)),
            float(off.max()),
        )
