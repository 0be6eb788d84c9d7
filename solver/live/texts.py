"""Frames as people write and read them: JSON with names, beside the bytes that programs send."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from solver.errors import quote
from solver.kinds.live_messages import GAP, HELD, RESUMED, FollowedFrame, GivenFrame, MessageError
from solver.live.session import LiveSession, arrays_of
from solver.live.source import LiveSource

FLAGS = {"held": HELD, "resumed": RESUMED, "gap": GAP}
MOST_NUMBER = 2**32 - 1  # of a frame
DECIMALS = 5  # of the values of an answer


def read_frame(said: Mapping[str, Any], source: LiveSource) -> GivenFrame:
    """Return the frame of a message with ``number``, ``seconds`` and ``values`` or ``weights``.

    Raises :class:`MessageError`.
    """
    number = said["number"]
    seconds: Any = said.get("seconds")
    if type(number) is not int or not 0 <= number <= MOST_NUMBER:
        raise MessageError(f"number is {quote(number)}, not a whole number from 0 to {MOST_NUMBER}")
    if seconds is None or not math.isfinite(_number(seconds, f"the time of frame {number}")):
        raise MessageError(f"seconds of frame {number} are {quote(seconds)}, not a number")
    if isinstance(said.get("weights"), dict):
        rows = _read_weights(said["weights"], source, number)
    elif isinstance(said.get("values"), list):
        rows = _read_places(said["values"], source, number)
    else:
        raise MessageError(f"frame {number} has no list of values and no weights by name")
    return GivenFrame(number, float(seconds), rows.astype("<f4").tobytes())


def _read_weights(weights: Mapping[str, Any], source: LiveSource, number: int) -> np.ndarray:
    places = {name: place for place, name in enumerate(source.labels)}
    rows = np.full((source.rows, source.width), np.nan)
    for name, value in weights.items():
        # as ARKit writes names: Live Link Face begins with a capital
        place = places.get(name[:1].lower() + name[1:])
        if place is None or source.width != 1:
            raise MessageError(f"frame {number} has the weight {quote(name)}, which is no label")
        rows[place] = _number(value, f"{quote(name)} of frame {number}")
    return rows


def _read_places(values: list[Any], source: LiveSource, number: int) -> np.ndarray:
    if len(values) != source.rows:
        raise MessageError(f"frame {number} has {len(values)} rows, not {source.rows}")
    rows = np.full((source.rows, source.width), np.nan)
    for place, value in enumerate(values):
        where = f"row {place} of frame {number}"
        if source.width == 1:
            rows[place] = _number(value, where)
        elif value is not None:
            if not isinstance(value, list) or len(value) != source.width:
                raise MessageError(f"{where} is {quote(value)}, not three numbers or null")
            rows[place] = [_number(each, where) for each in value]
    return rows


def _number(value: Any, where: str) -> float:
    """Return a number, NaN for null."""
    if value is None:
        return math.nan
    if type(value) not in (int, float):
        raise MessageError(f"{where} is {quote(value)}, not a number or null")
    try:
        return float(value)
    except OverflowError:
        return math.nan


def describe_frame(frame: FollowedFrame, session: LiveSession) -> dict[str, Any]:
    """Return a followed frame as a message with names."""
    found = arrays_of(frame, session.layout)
    parts = {name: array.round(DECIMALS).tolist() for name, array in found.items()}
    values = parts.pop("values")
    contractions = parts.pop("contractions")
    return {
        "type": "frame",
        "number": frame.number,
        "seconds": frame.seconds,
        "solve_ms": round(frame.solve_ms, 3),
        "error_p50_mm": _finite(frame.error_p50_mm),
        "error_p95_mm": _finite(frame.error_p95_mm),
        "dropped": frame.dropped,
        "flags": [name for name, bit in FLAGS.items() if frame.flags & bit],
        "weights": dict(zip(session.face.skin.names, values, strict=True)),
        "contractions": dict(zip(session.face.rig.model.muscle_names, contractions, strict=True)),
        **parts,
    }


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
