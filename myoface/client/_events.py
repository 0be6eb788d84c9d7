"""Server-sent events, out of the bytes as they arrive."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """What the service tells about a job."""

    kind: str
    data: dict[str, Any]


class EventReader:
    """Takes the bytes of a stream, in pieces that may end anywhere."""

    def __init__(self) -> None:
        self._rest = b""
        self._fields: dict[str, str] = {}

    def feed(self, content: bytes) -> Iterator[Event]:
        """Yield the events that are complete now."""
        *lines, self._rest = (self._rest + content).split(b"\n")
        for line in lines:
            text = line.decode().rstrip("\r")
            if text:
                name, _, value = text.partition(":")  # a comment has no name
                self._fields[name] = value.removeprefix(" ")
            else:
                fields, self._fields = self._fields, {}
                if "event" in fields and "data" in fields:
                    yield Event(fields["event"], json.loads(fields["data"]))
