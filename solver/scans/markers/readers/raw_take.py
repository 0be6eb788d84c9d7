"""Tracks as a file has them, before labels and units are settled, and how a file is refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from solver.errors import Finding, InputError, advise, file_error
from solver.kinds.kind import MM_A_UNIT
from solver.surface import Floats

ADVICE = {
    "markers.unreadable": "Export the take again, as C3D, TRC, Motive CSV or NPZ.",
    "markers.truncated": "Copy or upload the file again; it was cut off on the way.",
    "markers.too_large": "Cut the take into shorter ones, or export it without unlabelled tracks.",
    "markers.none": "Export the labelled trajectories; analog data alone hold no face.",
    "markers.labels": "Give each marker a name of its own in the capture software.",
    "markers.two_faces": "Export each person's markers to a file of their own.",
    "markers.unit": "Write the unit of lengths in the capture software's export.",
    "markers.rate": "Write the frame rate in the export.",
    "markers.frames": "Nothing to do: frames that the file leaves out count as missing.",
    "markers.far": "Nothing to do: such points count as missing.",
    "markers.header": "Export the take again if the number of its frames is not right.",
}

make_finding = partial(advise, ADVICE)
unreadable_error = partial(file_error, "markers.unreadable")


MOST_FRAME = 10**9  # a frame's number


@dataclass(frozen=True)
class TakeOptions:
    """Bounds of what is read, and sizes and rates that are likely."""

    most_bytes: int = 2 << 30  # of a file
    most_values: int = 40_000_000  # coordinates of all tracks: 320 MB
    most_tracks: int = 10_000
    longest_line: int = 4 << 20  # characters of a line of text
    farthest_mm: float = 1e5  # a point beyond it is no place in a studio
    face_mm: tuple[float, float] = (30.0, 120.0)  # markers of a face spread as far, rms
    seen_mm: tuple[float, float] = (12.0, 1500.0)  # a child's few to a body's many
    rates: tuple[float, float] = (0.01, 10_000.0)  # Hz
    units_mm: tuple[float, float] = MM_A_UNIT  # of a file that says it as a number
    least_sigma: float = 1e-9  # standard deviation in units of the file: no point is surer
    rate_slack: float = 0.005  # by which two rates in a file may differ
    most_gaps: float = 1.0  # frames that are left out, for each that is there


TAKE_OPTIONS = TakeOptions()


@dataclass(frozen=True)
class Event:
    """Something that the file marks in time."""

    name: str
    time: float  # s, on the clock of the file


@dataclass
class RawTake:
    """n tracks of f frames, in the units of the file.

    ``points`` (f, n, 3) is NaN where the file leaves a point out or marks it so.
    """

    names: Sequence[str]  # (n,) as the file has them; shorter where tracks have no name
    points: Floats
    rate: float  # Hz; NaN where the file has none
    first: int = 1  # number of the first frame
    unit: str | float | None = None  # its name as the file has it, or mm
    residual: Floats | None = None  # (f, n) in the file's units, NaN if unknown
    sigma: Floats | None = None  # (f, n, 3) in the file's units
    up: str | None = None  # the axis that is up by the file
    events: tuple[Event, ...] = ()
    findings: list[Finding] = field(default_factory=list)


def truncated_error(file: str, reason: str, **context: Any) -> InputError:
    """Return the error of a file that ends too early."""
    message = f"{file} ends too early: {reason}"
    return InputError("markers.truncated", message, file=file, **context)


def decode(text: bytes) -> str:
    """Return text as the file means it: UTF-8, or what Western programs wrote before it."""
    try:
        return text.decode("utf-8").strip("\0 ")
    except UnicodeDecodeError:
        return text.decode("latin-1").strip("\0 ")


def check_room(file: str, frames: int, tracks: int, options: TakeOptions) -> None:
    """Raise :class:`InputError` (``markers.none``, ``markers.too_large``) before room is made."""
    if not frames or not tracks:
        what = "frames" if tracks else "points"
        raise InputError("markers.none", f"{file} has no {what}", file=file)
    values = 3 * frames * tracks
    if values > options.most_values or tracks > options.most_tracks:
        message = (
            f"{file} has {frames} frames of {tracks} tracks; at most {options.most_tracks} tracks "
            f"and {options.most_values // 3} points can be read"
        )
        raise InputError("markers.too_large", message, file=file, frames=frames, tracks=tracks)


def spread_frames(
    file: str, numbers: Sequence[int], points: Floats, options: TakeOptions
) -> tuple[Floats, list[Finding]]:
    """Return points (f, n, 3) with NaN for the frames that ``numbers`` (increasing) leave out."""
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    if not missing:
        return points, []
    if missing > options.most_gaps * len(numbers):
        step = int(np.argmax(np.diff(np.array(numbers, np.int64))))
        before, after = numbers[step], numbers[step + 1]
        raise unreadable_error(file, f"frame {after} follows frame {before}", frame=after)
    check_room(file, len(numbers) + missing, points.shape[1], options)
    spread = np.full((len(numbers) + missing, *points.shape[1:]), np.nan)
    spread[np.array(numbers, np.int64) - numbers[0]] = points
    message = f"{file} leaves out {missing} of {len(spread)} frames."
    return spread, [make_finding("markers.frames", "warning", message, file=file, frames=missing)]


def choose_rate(
    file: str, sources: Iterable[tuple[str, float]], options: TakeOptions
) -> tuple[float, list[Finding]]:
    """Return the rate in Hz by the first of the sources that has one; NaN if none has.

    ``sources`` are rates by the names of their places in the file; a finding where they differ.
    """
    rates = list(sources)
    least, most = options.rates
    usable = [(place, rate) for place, rate in rates if least <= rate <= most]
    if not usable:
        words = ", ".join(f"{place} {rate:g}" for place, rate in rates) or "nothing"
        message = f"{file} has no usable frame rate ({words})."
        return float("nan"), [make_finding("markers.rate", "warning", message, file=file)]
    place, rate = usable[0]
    others = [each for each in usable[1:] if abs(each[1] / rate - 1.0) > options.rate_slack]
    if len(usable) == len(rates) and not others:
        return rate, []
    words = ", ".join(f"{where} {value:g} Hz" for where, value in rates)
    message = f"{file} says different rates: {words}; it is read at {rate:g} Hz, by {place}."
    return rate, [make_finding("markers.rate", "warning", message, file=file, found=rate)]
