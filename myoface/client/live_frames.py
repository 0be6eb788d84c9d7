"""Live sessions as the API shows them, and their frames in bytes: docs/reference/live.md."""

from __future__ import annotations

import math
import struct
import sys
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple, TypeAlias

from myoface.errors import ApiError
from myoface.resources import State
from myoface.values import Resource

NOT_A_FRAME = "client.frame"
VERSION = 1

_GIVEN = struct.Struct("<4sHHId")  # "MYF>", version, 0, number, seconds; then float32
_FOLLOWED = struct.Struct("<4sHHIdfffI")  # "MYF<", version, flags, and as `LiveFrame` has it
_BEGINS = struct.pack("<4sH", b"MYF<", VERSION)

# Weights or places: float32 in bytes, an array, rows (None: not seen), or either by their names
Numbers: TypeAlias = "bytes | array[float] | Iterable[Any] | Mapping[str, Any]"


@dataclass(frozen=True, kw_only=True)
class LiveSession(Resource):
    """A live session; the job of the same id has its options, log, figures and takes."""

    id: str
    subject_id: str
    rig_id: str
    source: str
    state: State
    attempt: int
    error: dict[str, Any] | None = None
    created_at: datetime | None = None
    started_at: datetime | None = None
    finished_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class LiveTicket(Resource):
    """What opens one connection to a session, once; ``url`` is relative to the service's."""

    ticket: str
    url: str
    expires_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class OpenedSession(LiveTicket, LiveSession):
    """A session and the ticket of its station."""


class Timed(NamedTuple):
    """Numbers of a frame, and when it was captured by the station's clock in s."""

    seconds: float
    numbers: Numbers


@dataclass(frozen=True)
class LiveFrame:
    """A face that followed a frame: arrays by the names of the session's layout, one after another.

    ``error_p50_mm`` and ``error_p95_mm`` are those of the last 10 s, NaN before anything is known.
    """

    number: int
    seconds: float
    solve_ms: float
    error_p50_mm: float
    error_p95_mm: float
    dropped: int  # frames so far that came too fast to be followed
    is_held: bool  # the frame said nothing of use: the face is as before
    is_resumed: bool  # the first one of a worker that goes on for another
    is_gap: bool  # the clock jumped: what was before counts no more
    arrays: Mapping[str, array[float]]


def pack_frame(number: int, seconds: float, numbers: Numbers, expects: Mapping[str, Any]) -> bytes:
    """Return a frame in bytes.

    ``expects`` is that of the session's ready message: names are put into the order of its
    ``labels``, and those that are missing were not seen.
    """
    head = _GIVEN.pack(b"MYF>", VERSION, 0, number % 2**32, seconds)
    return head + _in_bytes(numbers, int(expects.get("width", 1)), expects.get("labels") or ())


def read_frame(data: bytes, layout: Sequence[Mapping[str, Any]]) -> LiveFrame:
    """Return the frame in ``data``, whose arrays are as ``layout`` of the ready message has them.

    Raises
    ------
    ApiError
        ``client.frame`` for bytes that are no frame of this release's.
    """
    if len(data) < _FOLLOWED.size or not data.startswith(_BEGINS):
        detail = f"{len(data)} bytes that are no frame of a live session's"
        raise ApiError({"code": NOT_A_FRAME, "detail": detail})
    _, _, flags, number, seconds, solve, p50, p95, dropped = _FOLLOWED.unpack_from(data)
    numbers = array("f", data[_FOLLOWED.size :])
    if sys.byteorder == "big":
        numbers.byteswap()
    arrays = {}
    start = 0
    for each in layout:
        end = start + math.prod(each["shape"])
        arrays[each["name"]] = numbers[start:end]
        start = end
    held, resumed, gap = (bool(flags & bit) for bit in (1, 2, 4))
    return LiveFrame(number, seconds, solve, p50, p95, dropped, held, resumed, gap, arrays)


def _in_bytes(numbers: Numbers, width: int, labels: Sequence[str]) -> bytes:
    if isinstance(numbers, bytes):
        return numbers
    if isinstance(numbers, Mapping):
        numbers = [numbers.get(label) for label in labels]
    flat: list[float] = []
    for row in numbers:
        if row is None:
            flat += [math.nan] * width
        elif isinstance(row, Iterable):
            flat += map(float, row)
        else:
            flat.append(row)
    packed = array("f", flat)
    if sys.byteorder == "big":
        packed.byteswap()
    return packed.tobytes()
