"""Faces as lines of JSON: frames and controls that are read, and what a session sends.

A line that is read is a frame, as the session's WebSocket takes them in text, or a control:

    {"number": 7, "seconds": 0.1, "weights": {"jawOpen": 0.3}}
    {"seconds": 0.1, "values": [[1.0, 2.0, 3.0], null]}
    {"record": "take 1"}    {"stop": true}    {"end": true}
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

from myoface.live.readings import Reading, ReadingError

LONGEST = 8 << 20  # characters of a line
CONTROLS = {"record": str, "stop": bool, "end": bool}


def read_line(line: str) -> Reading | dict[str, Any]:
    """Return the frame or the control in a line; raises :class:`ReadingError`."""
    if len(line) > LONGEST:
        raise ReadingError(f"a line has {LONGEST} characters at most")
    try:
        said = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ReadingError(f"this is not JSON: {error}") from error
    if not isinstance(said, dict):
        raise ReadingError("a line is an object: a frame or a control")
    for name, form in CONTROLS.items():
        if name in said:
            if len(said) != 1 or not isinstance(said[name], form):
                raise ReadingError(f"{name} is a control of its own, with a {form.__name__}")
            return said
    values = said.get("weights", said.get("values"))
    if not isinstance(values, dict | list):
        raise ReadingError("a frame has weights by name, or values in the order of the rows")
    seconds = said.get("seconds", time.monotonic())
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        raise ReadingError("seconds is a number")
    return Reading(float(seconds), values)


def write_line(said: Mapping[str, Any]) -> str:
    """Return what a session said as a line."""
    return json.dumps(said, allow_nan=False, separators=(",", ":")) + "\n"
