"""Faces as lines of JSON: frames and controls that are read, and what a session sends.

A line that is read is a frame, as the session's WebSocket takes them in text but for its number,
which the station counts itself, or a control:

    {"number": 7, "seconds": 0.1, "weights": {"jawOpen": 0.3}}
    {"seconds": 0.1, "values": [[1.0, 2.0, 3.0], null]}
    {"record": "take_1"}    {"stop": true}    {"end": true}
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from math import isnan
from typing import Any

from myoface.client import LiveFrame, Timed
from myoface.live.datagrams import PacketError

LONGEST = 8 << 20  # characters of a line
CONTROLS = {"record": str, "stop": bool, "end": bool}


def read_line(line: str) -> Timed | dict[str, Any]:
    """Return the frame or the control in a line; raises :class:`PacketError`."""
    if len(line) > LONGEST:
        raise PacketError(f"a line has {LONGEST} characters at most")
    try:
        said = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise PacketError(f"this is not JSON: {error}") from error
    if not isinstance(said, dict):
        raise PacketError("a line is an object: a frame or a control")
    for name, form in CONTROLS.items():
        if name in said:
            if len(said) != 1 or not isinstance(said[name], form):
                raise PacketError(f"{name} is a control of its own, with a {form.__name__}")
            return said
    values = said.get("weights", said.get("values"))
    if not isinstance(values, dict | list):
        raise PacketError("a frame has weights by name, or values in the order of the rows")
    seconds = said.get("seconds", time.monotonic())
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        raise PacketError("seconds is a number")
    return Timed(float(seconds), values)


def write_line(said: Mapping[str, Any]) -> str:
    """Return what a session said as a line."""
    return json.dumps(said, allow_nan=False, separators=(",", ":")) + "\n"


def tell_frame(
    frame: LiveFrame, ready: Mapping[str, Any], latency_ms: float | None
) -> dict[str, Any]:
    """Return a followed frame as a session says it in text; what is not known is null.

    ``ready`` is what the session said of its names. Amounts and skin, which need the session's
    shapes to be of use, are left out, and the station's ``latency_ms`` is told besides.
    """
    head, jaw, values, pulls = (
        [*map(_rounded, frame.arrays[name])] for name in ("head", "jaw", "values", "contractions")
    )
    flags = {"held": frame.is_held, "resumed": frame.is_resumed, "gap": frame.is_gap}
    return {
        "type": "frame",
        "number": frame.number,
        "seconds": frame.seconds,
        "latency_ms": _rounded(latency_ms),
        "solve_ms": _rounded(frame.solve_ms),
        "error_p50_mm": _rounded(frame.error_p50_mm),
        "error_p95_mm": _rounded(frame.error_p95_mm),
        "dropped": frame.dropped,
        "flags": [name for name, is_set in flags.items() if is_set],
        "weights": dict(zip(ready["sliders"], values, strict=True)),
        "contractions": dict(zip(ready["muscles"], pulls, strict=True)),
        "head": [head[row : row + 4] for row in range(0, 16, 4)],
        "jaw": jaw,
    }


def _rounded(value: float | None) -> float | None:
    """Return a number with as many digits as single precision has."""
    return None if value is None or isnan(value) else float(f"{value:.7g}")
