"""Takes that a live session records: every frame that came, as the jobs of exact fits read them.

Markers are left as NPZ (:func:`~solver.scans.markers.readers.take.read_take`), weights as a
recording of Live Link Face, points as an array of frames (:mod:`solver.scans.performance`),
landmarks as NPZ of ``names`` and ``points``. While a take is recorded its frames are in a file of
plain numbers, with the faces that were sent of them (:mod:`solver.live.sent`), so that nothing is
lost where a process dies.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError, quote
from solver.kinds.live_session import PART, Source
from solver.live.landmarks import IMAGE_AXES
from solver.live.sent import AMOUNT, TOLD, SentModes, SentTake, part_of, write_takes
from solver.scans.live_link import ARKIT_NAMES, FaceTake, head_turn
from solver.scans.live_link import write_signals as write_recording
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.motion import last_true
from solver.scans.performance import write_performance
from solver.storage import hash_file
from solver.surface import Floats

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class TakeLimits:
    """Bounds of a take."""

    most_bytes: int = 4 << 30
    most_frames: int = 1_000_000
    longest_gap_s: float = 60.0  # in a take of frames at even times: more of it is left out
    back_s: float = 1.0  # a clock that goes back by more was set anew: the take goes on
    # from which on a session begins no more: a job's files are bounded
    most_takes: int = 150
    most_left_bytes: int = 6 << 30


@dataclass(frozen=True)
class LeftTake:
    """A take as a session leaves it."""

    name: str
    file: str
    frames: int
    seconds: float


@dataclass(frozen=True, eq=False)
class SentFace:
    """What was sent of a frame: amounts (r,) of the skin's modes, and the running error, mm."""

    amounts: Floats
    told: tuple[float, float]  # p50 and p95, NaN where it is not known


class TakeWriter:
    """Writes the frames (rows, width) of one take as they come, and what was sent of them.

    ``modes`` are those of the skin that is sent.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        source: Source,
        labels: Sequence[str],
        shape: tuple[int, int],
        modes: SentModes,
        options: TakeLimits = TakeLimits(),
    ) -> None:
        self.name = name
        self.frames = 0
        self._path = folder / f"{file_name(name, source)}{PART}"
        self._options = options
        self._row = _row(shape, len(modes.basis))
        self._stream = self._path.open("wb")
        header = {
            "name": name,
            "source": source,
            "labels": list(labels),
            "shape": list(shape),
            "modes": len(modes.basis),
            "of": modes.identity,
        }
        self._stream.write(json.dumps(header).encode() + b"\n")
        self._stream.flush()

    @property
    def is_full(self) -> bool:
        """Return whether no more frames may be added."""
        options = self._options
        size = self.frames * self._row.itemsize
        return self.frames >= options.most_frames or size >= options.most_bytes

    def add(
        self, seconds: float, numbers: NDArray[np.float32], sent: SentFace | None = None
    ) -> None:
        """Write a frame (rows, width) at a time of the station's; ``sent`` is what was of it."""
        row = np.zeros((), self._row)
        row["seconds"] = seconds
        row["numbers"] = numbers
        row["amounts"] = np.nan if sent is None else sent.amounts
        row["told"] = np.nan if sent is None else sent.told
        self._stream.write(row.tobytes())
        self._stream.flush()  # a process that is killed loses none
        self.frames += 1

    def finish(self) -> LeftTake | None:
        """Leave the take's file, as :func:`finish_part`."""
        self._stream.close()
        return finish_part(self._path, self._options)


def file_name(name: str, source: Source) -> str:
    """Return the file of a take."""
    return f"take_{name}{SUFFIXES[source]}"


def check_name(name: object, folder: Path, source: Source) -> str:
    """Return a take's name as it may stand in a file's.

    One that is taken gets a number behind it. Raises :class:`InputError` (``live.take_name``).
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        message = (
            f"'{quote(name)}' is no name of a take: letters, digits, '.', '_' and '-', 64 at most"
        )
        raise InputError("live.take_name", message, found=quote(name))
    chosen = name
    number = 1
    while any((folder / f"{file_name(chosen, source)}{end}").exists() for end in ("", PART)):
        number += 1
        chosen = f"{name}-{number}"
    return chosen


def check_room(files: Collection[Path], options: TakeLimits = TakeLimits()) -> None:
    """Raise :class:`InputError` (``live.takes_full``) where a session has left enough takes."""
    size = sum(path.stat().st_size for path in files)
    if len(files) >= options.most_takes or size >= options.most_left_bytes:
        message = (
            f"the session has left {len(files)} takes of {size / 1e9:.1f} GB, which is as much as "
            "it may: end it, and go on in another one"
        )
        raise InputError("live.takes_full", message, found=len(files))


def finish_part(path: Path, options: TakeLimits = TakeLimits()) -> LeftTake | None:
    """Make the file of a take of what was recorded of it; None where it has no whole frame.

    What was sent of its frames is left beside it (:func:`~solver.live.sent.part_of`). What was
    recorded stays until :func:`drop_part`, of a take without frames nothing does.
    """
    with path.open("rb") as stream:
        line = stream.readline()
        begin = stream.tell()
    count = 0
    if line.endswith(b"\n"):  # else the process died as it wrote the header
        header = json.loads(line)
        row = _row(tuple(header["shape"]), header["modes"])
        count = (path.stat().st_size - begin) // row.itemsize
    if not count:
        path.unlink()
        return None
    frames = np.memmap(path, row, "r", begin, (count,))
    out = path.with_name(path.name.removesuffix(PART))
    seconds = _one_clock(np.array(frames["seconds"]), options)
    later = np.flatnonzero(np.append(True, np.diff(np.maximum.accumulate(seconds)) > 0))
    seconds = seconds[later]
    source: Source = header["source"]
    recorded = _Recorded(out, header["labels"], seconds, frames["numbers"], later, options)
    WRITERS[source](recorded)
    rows = later[recorded.seen] if source == "weights" else recorded.even
    _leave_sent(out, header, frames, rows)
    return LeftTake(header["name"], out.name, len(later), float(seconds[-1] - seconds[0]))


def _one_clock(seconds: Floats, options: TakeLimits) -> Floats:
    """Return times (f,) of which the clock was never set back: a usual step is there instead."""
    steps = np.diff(seconds)
    forward = steps[steps > 0.0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    steps[steps < -options.back_s] = usual
    return np.asarray(seconds[0] + np.append(0.0, np.cumsum(steps)))


def drop_part(folder: Path, take: LeftTake) -> None:
    """Remove what was recorded of a take that is whole; call it once the take is listed."""
    (folder / f"{take.file}{PART}").unlink(missing_ok=True)


def _leave_sent(
    take: Path, header: Mapping[str, Any], recorded: NDArray[np.void], rows: NDArray[np.int64]
) -> None:
    """Leave what was sent of a take; ``rows`` (f,) of what was recorded are its frames, or -1."""
    amounts = recorded["amounts"][rows]
    sent = (rows >= 0) & np.isfinite(amounts).all(axis=1)
    known = recorded["told"][np.isfinite(recorded["told"]).all(axis=1)].astype(np.float64)
    told: list[float | None] = known[-1].round(4).tolist() if len(known) else [None, None]
    error = dict(zip(TOLD, told, strict=True))
    frames = np.flatnonzero(sent)
    left = SentTake(header["name"], hash_file(take), error, frames, amounts[sent])
    write_takes(part_of(take), header["of"], [left])


@dataclass(frozen=True)
class _Recorded:
    """Frames to be written: those of the ``rows`` (f,) of ``numbers``, at ``seconds`` (f,)."""

    path: Path
    labels: Sequence[str]
    seconds: Floats
    numbers: NDArray[np.float32]
    rows: NDArray[np.int64]
    options: TakeLimits

    @cached_property
    def rate(self) -> float:
        """The usual number of frames a second; 60 of a single frame."""
        if len(self.seconds) < 2:
            return 60.0
        return float(np.clip(1.0 / np.median(np.diff(self.seconds)), 1.0, 1000.0))

    @cached_property
    def even(self) -> NDArray[np.int64]:
        """The row of every frame at even times, -1 for one that did not come."""
        steps = np.rint(np.diff(self.seconds) * self.rate).astype(np.int64)
        most = int(self.options.longest_gap_s * self.rate)
        places = np.append(0, np.cumsum(np.clip(steps, 0, most)))
        found = np.full(places[-1] + 1, -1, np.int64)
        found[places] = self.rows
        return found

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """In which frames (f,) a weight was seen: a recording has these alone."""
        weights = self.numbers[self.rows, : len(ARKIT_NAMES), 0]
        return np.asarray(np.isfinite(weights).any(axis=1))

    def points(self) -> Floats:
        """Return frames (f, k, 3) at even times, NaN where nothing was seen."""
        rows = self.even
        points = np.array(self.numbers[np.maximum(rows, 0)], np.float64)
        points[(rows < 0)[:, None] | ~np.isfinite(points).all(axis=2)] = np.nan
        return points


def _write_markers(made: _Recorded) -> None:
    Take(made.path.name, tuple(made.labels), made.points(), made.rate).save(made.path, packed=False)


def _write_landmarks(made: _Recorded) -> None:
    points = made.points() @ IMAGE_AXES
    names = np.array([str(number) for number in range(points.shape[1])])
    np.savez(made.path, names=names, points=points, rate=made.rate)


def _write_points(made: _Recorded) -> None:
    rows = made.even
    nothing = np.full(made.numbers.shape[1:], np.nan, np.float32)
    frames = (made.numbers[row] if row >= 0 else nothing for row in rows.tolist())
    write_performance(made.path, frames, len(rows), made.numbers.shape[1])


def _write_weights(made: _Recorded) -> None:
    numbers = np.array(made.numbers[made.rows, :, 0], np.float64)
    count = len(ARKIT_NAMES)
    held = _hold(numbers)
    turns = [
        np.array([head_turn(angles) for angles in held[:, count + 3 * bone : count + 3 * bone + 3]])
        for bone in range(3)
    ]
    take = FaceTake(
        made.seconds - made.seconds[0],
        np.clip(held[:, :count], 0.0, 1.0),
        turns[0],
        np.stack(turns[1:], axis=1),
        made.seen,
        "live_link",
    )
    write_recording(made.path, take)


def _hold(numbers: Floats) -> Floats:
    """Return columns (f, c) whose NaN are as the last number before, 0 before the first."""
    last = last_true(np.isfinite(numbers))
    found = np.take_along_axis(numbers, np.maximum(last, 0), axis=0)
    return np.where(last < 0, 0.0, found)


SUFFIXES: Final[dict[Source, str]] = {
    "markers": ".npz",
    "weights": ".csv",
    "points": ".npy",
    "landmarks": ".npz",
}
WRITERS: Final[dict[Source, Callable[[_Recorded], None]]] = {
    "markers": _write_markers,
    "weights": _write_weights,
    "points": _write_points,
    "landmarks": _write_landmarks,
}


def _row(shape: tuple[int, ...], modes: int) -> np.dtype[np.void]:
    sent = [("amounts", AMOUNT, (modes,)), ("told", "<f4", (2,))]
    return np.dtype([("seconds", "<f8"), ("numbers", "<f4", shape), *sent])
