"""A take in a file, played again at its own rate."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path

import anyio

from myoface.client import Timed

BEGIN = 4096  # bytes in which a recording of Live Link Face names its columns
CLOCK = b"timecode"
WEIGHT = b"jawopen"


@dataclass(frozen=True)
class Replay:
    """Frames of a file, with their times in s, and which source of a session they are."""

    source: str
    rate: float
    frames: Iterator[Timed]

    @classmethod
    def open(cls, path: Path, rate: float) -> Replay:
        """Open a recording of Live Link Face, a take of markers, or a performance (.npy).

        A file that says no rate, as a performance, has the one that is given, in frames a second.
        Raises as the solver's readers do.
        """
        with path.open("rb") as file:
            begin = file.read(BEGIN).lower()
        if path.suffix.lower() == ".npy":
            return cls._points(path, rate)
        if CLOCK in begin and WEIGHT in begin:
            return cls._weights(path, rate)
        return cls._markers(path, rate)

    @classmethod
    def _weights(cls, path: Path, rate: float) -> Replay:
        from solver.scans.live_link import ARKIT_NAMES, read_live_link

        take = read_live_link(path)
        times = take.times.tolist()
        rows = zip(times, take.weights.tolist(), strict=True)
        frames = (Timed(at, dict(zip(ARKIT_NAMES, row, strict=True))) for at, row in rows)
        known = (len(times) - 1) / times[-1] if len(times) > 1 else rate
        return cls("weights", known, frames)

    @classmethod
    def _markers(cls, path: Path, rate: float) -> Replay:
        import numpy as np

        from solver.scans.markers.readers.take import read_take

        take = read_take(path)
        known = take.rate if np.isfinite(take.rate) else rate
        frames = (
            Timed(number / known, dict(zip(take.labels, points.tolist(), strict=True)))
            for number, points in enumerate(take.positions)
        )
        return cls("markers", known, frames)

    @classmethod
    def _points(cls, path: Path, rate: float) -> Replay:
        from solver.errors import InputError
        from solver.storage import map_array

        try:
            array = map_array(path)
            if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "fiu":
                raise ValueError(f"an array of {array.dtype} of the shape {array.shape}")
        except (OSError, ValueError) as error:
            message = f"{path.name} has no frames of points (f, n, 3): {error}"
            raise InputError("performance.unreadable", message, file=path.name) from error
        frames = (
            Timed(number / rate, points.astype("<f4").tobytes())
            for number, points in enumerate(array)
        )
        return cls("points", rate, frames)


async def play(frames: Iterator[Timed]) -> AsyncIterator[Timed]:
    """Yield frames when it is their time, counted from the first."""
    began: float | None = None
    for frame in frames:
        now = time.monotonic()
        began = now - frame.seconds if began is None else began
        await anyio.sleep(max(0.0, began + frame.seconds - now))
        yield frame
