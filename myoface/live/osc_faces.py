"""Faces in OSC: the addresses that are read, and those that followed frames are sent to.

Read are, until a message says that the frame is whole,

    /myoface/value/NAME w           a weight of ARKit's
    /myoface/point/LABEL x y z      a marker's place in mm
    /myoface/frame [number [s]]     the frame is whole; its time in s, else when it came
    /VMC/Ext/Blend/Val NAME w       the same by the protocol of virtual motion capture
    /VMC/Ext/Blend/Apply            the frame is whole

Sent are the frame's ``/myoface/value/NAME``, ``/myoface/contraction/MUSCLE``, ``/myoface/jaw`` (5
numbers), ``/myoface/head`` (a matrix, 16 numbers by rows) and then ``/myoface/frame number seconds
p50 p95 held``, with the running error in mm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from math import isfinite, isnan
from typing import Any

from myoface.client import LiveFrame, Timed
from myoface.live.datagrams import PacketError
from myoface.live.osc import Double, OscMessage, read_osc, write_osc

VALUE = "/myoface/value/"
POINT = "/myoface/point/"
FRAME = "/myoface/frame"
VMC_VALUE = "/VMC/Ext/Blend/Val"
VMC_FRAME = "/VMC/Ext/Blend/Apply"
MOST_NAMES = 4096  # of a frame


class OscReader:
    """Gathers what comes until a frame is whole."""

    def __init__(self) -> None:
        self._values: dict[str, float | list[float]] = {}

    def read(self, data: bytes) -> Timed | None:
        """Return the frame that a packet ends, None if it ends none.

        Messages at other addresses are passed over. Raises :class:`PacketError` for what is no
        OSC, or arguments of another form.
        """
        whole = None
        for message in list(read_osc(data)):
            address, arguments = message
            if address.startswith(VALUE):
                self._take(address.removeprefix(VALUE), arguments, 1)
            elif address.startswith(POINT):
                self._take(address.removeprefix(POINT), arguments, 3)
            elif address == VMC_VALUE:
                self._take(str(arguments[0]) if arguments else "", arguments[1:], 1)
            elif address in (FRAME, VMC_FRAME) and self._values:
                whole = Timed(_seconds(message), self._values)
                self._values = {}
        return whole

    def _take(self, name: str, arguments: tuple[object, ...], width: int) -> None:
        numbers = [float(each) for each in arguments if type(each) in (int, float)]  # type: ignore[arg-type]
        if not name or len(arguments) != width or len(numbers) != width:
            raise PacketError(f"{name or 'a value'} needs {width} numbers")
        if not all(map(isfinite, numbers)):
            raise PacketError(f"{name} is no number")
        if len(self._values) >= MOST_NAMES:
            self._values = {}
            raise PacketError(f"a frame has {MOST_NAMES} values at most")
        self._values[name] = numbers[0] if width == 1 else numbers


def _seconds(message: OscMessage) -> float:
    said = message.arguments[1:2] if message.address == FRAME else ()
    if not said:
        return time.monotonic()
    if not isinstance(said[0], int | float) or not isfinite(said[0]):
        raise PacketError("a frame's time is in seconds")
    return float(said[0])


def write_face(frame: LiveFrame, ready: Mapping[str, Any]) -> Iterator[bytes]:
    """Yield the packets of a followed frame; ``ready`` is what the session said of its names."""
    values = frame.arrays["values"]
    pulls = frame.arrays["contractions"]
    messages = [
        OscMessage(VALUE + name, (value,))
        for name, value in zip(ready["sliders"], values, strict=True)
    ]
    messages += [
        OscMessage(f"/myoface/contraction/{name.replace(' ', '_')}", (value,))
        for name, value in zip(ready["muscles"], pulls, strict=True)
        if not isnan(value)
    ]
    messages.append(OscMessage("/myoface/jaw", tuple(frame.arrays["jaw"])))
    messages.append(OscMessage("/myoface/head", tuple(frame.arrays["head"])))
    errors = frame.error_p50_mm, frame.error_p95_mm
    said = (frame.number, Double(frame.seconds), *errors, int(frame.is_held))
    messages.append(OscMessage(FRAME, said))
    yield from write_osc(messages)
