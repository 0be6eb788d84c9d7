"""Messages of live sessions, in bytes as docs/reference/live.md states them.

A frame is a header and numbers, all little-endian, numbers as float32. Whatever else is said is
JSON: ``{"record": NAME}``, ``{"stop": true}`` and ``{"end": true}`` by a client; by the session an
object with a ``type`` (``preparing``, ``ready``, ``recording``, ``take``, ``fault``, ``ended``).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

GIVEN = b"MYF>"  # a frame of a client's
FOLLOWED = b"MYF<"  # a frame of the session's
VERSION = 1  # of both layouts
LONGEST = 8 << 20  # bytes of a message: the session's may have the whole skin

_GIVEN = struct.Struct("<4sHHId")
_FOLLOWED = struct.Struct("<4sHHIdfffI")
_NUMBER = slice(8, 12)  # where both have it


class MessageError(ValueError):
    """Bytes that are no frame."""


class Message(NamedTuple):
    """A message as a WebSocket has it: text (JSON) or bytes (a frame)."""

    data: bytes
    is_text: bool = False

    @classmethod
    def of(cls, words: Mapping[str, Any]) -> Message:
        """Return the text message of an object."""
        return cls(json.dumps(words).encode(), is_text=True)

    @property
    def words(self) -> dict[str, Any]:
        """The object that a text message is; of any other message an empty one."""
        try:
            found = json.loads(self.data) if self.is_text else {}
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    @property
    def number(self) -> int:
        """The number of the frame that the message is, -1 of any other; nothing else is read."""
        if self.is_text:
            number = self.words.get("number")
            return number if isinstance(number, int) else -1
        is_whole = len(self.data) >= _NUMBER.stop
        return int.from_bytes(self.data[_NUMBER], "little") if is_whole else -1


@dataclass(frozen=True)
class GivenFrame:
    """A frame of a client's: its number, its time in s by the station's clock, and its numbers.

    These are places (k, 3) in mm or weights (k,), by rows; NaN for what was not seen.
    """

    number: int
    seconds: float
    numbers: bytes

    def pack(self) -> bytes:
        """Return the frame's bytes."""
        return _GIVEN.pack(GIVEN, VERSION, 0, self.number, self.seconds) + self.numbers

    @classmethod
    def unpack(cls, data: bytes) -> GivenFrame:
        """Return the frame in ``data``; raises :class:`MessageError`."""
        _, number, seconds = _check(data, _GIVEN, GIVEN)
        return cls(number, seconds, data[_GIVEN.size :])


@dataclass(frozen=True)
class FollowedFrame:
    """A frame of the session's: the number and time of the client's, how it went, and numbers.

    The numbers are those of the ready message's ``layout``, one array after the other.
    """

    number: int
    seconds: float
    solve_ms: float  # that following it took
    error_p50_mm: float  # of the last 10 s, NaN before the first full solve
    error_p95_mm: float
    dropped: int  # frames so far that came too fast to be followed
    flags: int  # bits of HELD, RESUMED, GAP
    numbers: bytes

    def pack(self) -> bytes:
        """Return the frame's bytes."""
        errors = (self.solve_ms, self.error_p50_mm, self.error_p95_mm)
        place = (self.number, self.seconds)
        header = _FOLLOWED.pack(FOLLOWED, VERSION, self.flags, *place, *errors, self.dropped)
        return header + self.numbers

    @classmethod
    def unpack(cls, data: bytes) -> FollowedFrame:
        """Return the frame in ``data``; raises :class:`MessageError`."""
        flags, number, seconds, solve, p50, p95, dropped = _check(data, _FOLLOWED, FOLLOWED)
        return cls(number, seconds, solve, p50, p95, dropped, flags, data[_FOLLOWED.size :])


# Flags of followed frames
HELD = 1  # the frame said nothing of use: the face is as before
RESUMED = 2  # the first frame of a worker that goes on for another
GAP = 4  # the clock jumped: what was before counts no more


def _check(data: bytes, layout: struct.Struct, magic: bytes) -> tuple[Any, ...]:
    """Return the header's numbers after magic and version."""
    if len(data) < layout.size:
        raise MessageError(f"{len(data)} bytes are no frame: its header has {layout.size}")
    found, version, *rest = layout.unpack_from(data)
    if found != magic:
        raise MessageError(f"a frame begins with {magic!r}, not {found!r}")
    if version != VERSION:
        raise MessageError(f"version {version} of frames: this release has {VERSION}")
    return tuple(rest)
