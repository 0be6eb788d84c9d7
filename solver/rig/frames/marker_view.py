"""``markers.bin``: where a fitted take's markers are and were seen, for a page that plays it.

docs/guide/rig-view.md describes it. Lengths are mm in the head's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from solver.rig.container import read_container, write_container
from solver.rig.frames import MarkerFrame
from solver.rig.frames.read_back import Comparison
from solver.similarity import small_motion
from solver.surface import Floats

FILE = "markers.bin"
FARTHEST = float(np.finfo(np.float16).max)  # mm that a point is off at most: what its bits hold
STATES = ("seen", "missing", "outlier", "swapped", "relabelled")


class MarkerView:
    """Collects frames of k markers and m muscles, to be written together."""

    def __init__(self, labels: Sequence[str], muscles: Sequence[str]) -> None:
        self._labels, self._muscles = list(labels), list(muscles)
        self._places: list[Floats] = []
        self._off: list[Floats] = []
        self._frames: list[MarkerFrame] = []

    def add(self, frame: MarkerFrame, places: Floats, seen: Floats) -> None:
        """Add a frame: ``places`` (k, 3) of the fitted face, points (k, 3) seen in the studio.

        A point that was seen nowhere is NaN.
        """
        back = small_motion(frame.head).inverse()
        self._places.append(places)
        self._off.append(back(seen) - places)
        self._frames.append(frame)

    def write(self, path: Path, fps: float) -> dict[str, Any]:
        """Write the file; returns how far its places, read back, are off, by frame and marker."""
        states = np.array([[STATES.index(each) for each in f.marker_state] for f in self._frames])
        header = {
            "labels": self._labels,
            "muscles": self._muscles,
            "states": list(STATES),
            "numbers": [frame.frame for frame in self._frames],
            "status": [frame.status for frame in self._frames],
            "fps": fps,
        }
        arrays: dict[str, np.ndarray] = {
            "places": np.array(self._places, np.float32),
            "off": np.clip(np.array(self._off), -FARTHEST, FARTHEST).astype(np.float16),
            "state": states.astype(np.uint8),
            "held": np.array([frame.held for frame in self._frames]).astype(np.uint8),
        }
        write_container(path, header, arrays)
        found = Comparison(path.name)
        stored = read_container(path).arrays["places"]
        for frame, shown, wanted in zip(self._frames, stored, self._places, strict=True):
            found.add(frame.frame, shown, wanted)
        return found.figures()
