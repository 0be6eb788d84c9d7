"""Readable tables behind the anatomies, and where their numbers come from.

Places in them are paths on a face by its landmarks. A point is a mean of landmarks:
``exocanthion*2+cheilion`` is a third of the way from the first to the second. Landmarks of both
sides are named without theirs, those of the middle as they are.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from solver.surface import Floats


def read_table(name: str, package: str = __name__) -> list[dict[str, str]]:
    """Return the rows of one of a package's CSV tables, this folder's by default, by column."""
    with resources.files(package).joinpath(f"{name}.csv").open() as stream:
        return list(csv.DictReader(stream))


def split_cell(cell: str) -> tuple[str, ...]:
    """Return what a cell lists between semicolons."""
    return tuple(cell.split("; ")) if cell else ()


def read_json(name: str) -> Any:
    """Return one of the folder's JSON files."""
    return json.loads(resources.files(__name__).joinpath(f"{name}.json").read_text())


SIDES = ("_l", "_r")


@dataclass(frozen=True)
class LandmarkPath:
    """A polyline by landmarks: for each ``point`` their weights, which sum to 1."""

    points: tuple[Mapping[str, float], ...]

    @classmethod
    def read(cls, cell: str) -> LandmarkPath:
        """Return the path of a table's cell, with a blank between points."""
        return cls(tuple(_weights(point) for point in cell.split()))

    @property
    def landmarks(self) -> set[str]:
        """Return the names of its landmarks, without sides."""
        return {name for point in self.points for name in point}

    def places(self, skin: Floats, landmarks: Mapping[str, int], sides: Sequence[str]) -> Floats:
        """Return its points (k, 3) in a ``skin`` (n, 3), a paired landmark being that of ``sides``.

        Both :data:`SIDES` are their mean. ``landmarks`` are skin vertices by name.
        """
        places = np.zeros((len(self.points), 3))
        for place, weights in zip(places, self.points, strict=True):
            for name, weight in weights.items():
                names = [name] if name in landmarks else [f"{name}{side}" for side in sides]
                place += weight * skin[[landmarks[each] for each in names]].mean(axis=0)
        return places


def missing_landmarks(paths: Iterable[LandmarkPath], landmarks: Mapping[str, int]) -> list[str]:
    """Return what paths are placed by that is not among ``landmarks``, without sides."""
    names = {name for path in paths for name in path.landmarks}
    both = {name for name in names if all(f"{name}{side}" in landmarks for side in SIDES)}
    return sorted(names - both - landmarks.keys())


def _weights(point: str) -> Mapping[str, float]:
    terms = [term.partition("*") for term in point.split("+")]
    counts = {name: float(count or 1) for name, _, count in terms}
    return {name: count / sum(counts.values()) for name, count in counts.items()}
