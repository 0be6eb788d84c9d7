"""Reading a recording of Live Link Face: ARKit's 52 weights in every frame, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from solver.errors import InputError
from solver.surface import Floats

TIMECODE = "timecode"
SIDED = (
    *("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide"),
    *("mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthPress"),
    *("mouthLowerDown", "mouthUpperUp", "browDown", "browOuterUp", "cheekSquint", "noseSneer"),
)
UNSIDED = (
    *("jawForward", "jawRight", "jawLeft", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker"),
    *("mouthRight", "mouthLeft", "mouthRollLower", "mouthRollUpper", "mouthShrugLower"),
    *("mouthShrugUpper", "browInnerUp", "cheekPuff", "tongueOut"),
)
ARKIT_NAMES = (*(name + side for name in SIDED for side in ("Left", "Right")), *UNSIDED)
"""ARKit's blend shapes; left is the subject's left."""

TICKS = 60
"""The last part of a timecode counts sixtieths of a second, whatever the frame rate is."""
DAY = 86400.0
WEIGHTS = (-0.5, 1.5)
"""What a weight may be: a solver goes a little beyond 0 and 1, percents do not fit in."""


@dataclass(frozen=True)
class LiveLinkTake:
    """``times`` (f,) in s after the first frame and ``weights`` (f, 52), named ARKIT_NAMES."""

    times: Floats
    weights: Floats


def read_live_link(path: Path) -> LiveLinkTake:
    """Return the weights of a recording; columns may come in any order, others are not read.

    Raises
    ------
    InputError
        ``live_link.unreadable``, ``live_link.columns`` (one is missing), ``live_link.value`` (a
        field is missing, no number, or not a weight), ``live_link.timecode`` or
        ``live_link.time_order`` (a frame is not later than the one before), with ``file``, and
        ``line`` where it is about one.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            header = [_arkit(name) for name in next(rows, ())]
            _check_columns(path, header)
            columns = [header.index(name) for name in ARKIT_NAMES]
            clock = header.index(TIMECODE)
            times: list[float] = []
            weights: list[list[float]] = []
            for row in rows:
                if row:
                    times.append(_time(path, rows.line_num, row, clock, times))
                    weights.append(_weights(path, rows.line_num, row, columns))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            "live_link.unreadable", f"{path.name} can not be read: {error}", file=path.name
        ) from error
    if not times:
        raise InputError("live_link.unreadable", f"{path.name} has no frames", file=path.name)
    return LiveLinkTake(np.array(times) - times[0], np.array(weights))


def _arkit(name: str) -> str:
    """Return a column's name as ARKit writes it: Live Link Face begins with a capital."""
    name = name.strip()
    return name[:1].lower() + name[1:]


def _check_columns(path: Path, header: Sequence[str]) -> None:
    missing = [name for name in (TIMECODE, *ARKIT_NAMES) if name not in header]
    if missing:
        raise InputError(
            "live_link.columns",
            f"{path.name} is not a recording of Live Link Face: it has no column "
            f"{', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}",
            file=path.name,
            line=1,
            missing=missing,
        )


def _time(path: Path, line: int, row: list[str], column: int, before: Sequence[float]) -> float:
    """Return a frame's time in s; a day is added to what follows midnight."""
    text = row[column] if column < len(row) else ""
    try:
        hours, minutes, seconds, ticks = text.split(":")
        time = 3600.0 * int(hours) + 60.0 * int(minutes) + int(seconds) + float(ticks) / TICKS
    except ValueError:
        _refuse(path, line, "timecode", f"{text!r} is not a timecode hours:minutes:seconds:ticks")
    if not 0.0 <= time < DAY:  # NaN is neither
        _refuse(path, line, "timecode", f"{text!r} is not a time of day")
    if before and time <= before[-1]:
        if before[-1] - time < DAY / 2:
            _refuse(path, line, "time_order", f"{text} is not later than the frame before")
        time += DAY
    return time


def _weights(path: Path, line: int, row: list[str], columns: Sequence[int]) -> list[float]:
    weights = []
    for name, column in zip(ARKIT_NAMES, columns, strict=True):
        text = row[column] if column < len(row) else ""
        try:
            weight = float(text)
        except ValueError:
            _refuse(path, line, "value", f"{name} is {text!r}, not a number")
        if not WEIGHTS[0] <= weight <= WEIGHTS[1]:
            _refuse(path, line, "value", f"{name} is {text}, which is no weight from 0 to 1")
        weights.append(weight)
    return weights


def _refuse(path: Path, line: int, code: str, what: str) -> NoReturn:
    raise InputError(
        f"live_link.{code}", f"{path.name}, line {line}: {what}", file=path.name, line=line
    )
