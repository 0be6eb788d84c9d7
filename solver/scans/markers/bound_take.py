"""Read a take by a marker set: the points of its markers, as the model's axes have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.scans.markers.marker_set import Marker, MarkerSet
from solver.scans.markers.take import Take
from solver.surface import Floats


class BoundTake:
    """A take's points of a set's markers, in the model's axes and mm.

    Raises :class:`InputError` ``markers.few`` where the take has fewer than ``least`` of them.
    """

    def __init__(self, take: Take, markers: MarkerSet, least: int) -> None:
        self.markers: tuple[Marker, ...] = tuple(
            marker for marker in markers.markers if marker.part != "ignore"
        )
        self._take, self._set, self._session = take, markers, markers.session
        number = {label: column for column, label in enumerate(take.labels)}
        self._columns = np.array([number.get(each.label, -1) for each in self.markers], np.int64)
        known = int(np.sum(self._columns >= 0))
        if known < least:
            message = (
                f"{take.file} has {known} of the marker set's {len(self.markers)} labels: "
                f"{least} are needed"
            )
            raise InputError("markers.few", message, file=take.file, found=known)

    def save(self, used: Sequence[Marker], path: Path) -> None:
        """Write the set with the markers that are ``used`` as they are now."""
        others = (marker for marker in self._set.markers if marker.part == "ignore")
        replace(self._set, markers=(*used, *others)).save(path)

    @property
    def frames(self) -> range:
        """Return the numbers of the take's frames, as its file counts them."""
        return self._take.numbers

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the markers' labels."""
        return tuple(marker.label for marker in self.markers)

    def points(self, frame: int) -> Floats:
        """Return the points (k, 3) of the frame with a number, NaN where one is missing."""
        found = self._session(self._take.positions[self.frames.index(frame)][self._columns])
        return np.where(self._columns[:, None] < 0, np.nan, found)

    def unlabelled(self, frame: int) -> Floats:
        """Return a frame's points (u, 3) without a label."""
        return self._session(self._take.unlabelled[self.frames.index(frame)])

    def sigma(self, frame: int) -> Floats | None:
        """Return the standard deviations (k, 3) that the take has of them, None if it has none."""
        if self._take.sigma is None:
            return None
        variance = self._take.sigma[self.frames.index(frame)][self._columns] ** 2
        return np.asarray(self._session.scale * np.sqrt(variance @ self._session.rotation.T**2))
