"""Open Sound Control 1.0: messages in packets, and bundles of them.

It is read here, not by a library: packets come from anybody, and python-osc 1.10 reads a bundle
whose part has a negative length for ever.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from myoface.live.datagrams import PacketError

Argument = int | float | str | bytes | bool | None

BUNDLE = b"#bundle\0"
AT_ONCE = b"\0\0\0\0\0\0\0\1"  # the time tag of what is to be done when it comes
DEEPEST = 4  # bundles within bundles
LONGEST = 1400  # bytes of a packet that is sent: one frame of an Ethernet

_NUMBERS = {tag: struct.Struct(f">{tag}") for tag in "ifd"} | {"h": struct.Struct(">q")}
_WORDS: dict[str, Argument] = {"T": True, "F": False, "N": None, "I": float("inf")}
_INT = _NUMBERS["i"]


class Double(float):
    """A number that is sent as float64."""


class OscMessage(NamedTuple):
    """An address, such as ``/myoface/jaw``, and its arguments."""

    address: str
    arguments: tuple[Argument, ...]


def read_osc(data: bytes, deepest: int = DEEPEST) -> Iterator[OscMessage]:
    """Yield the messages of a packet in their order; raises :class:`PacketError`."""
    if not data.startswith(BUNDLE):
        yield _read_message(data)
        return
    if deepest == 0:
        raise PacketError(f"bundles lie {DEEPEST} deep at most")
    place = len(BUNDLE) + len(AT_ONCE)
    if len(data) < place:
        raise PacketError("the bundle ends early")
    while place < len(data):
        length, place = _number(data, place, _INT)
        if not 0 < length <= len(data) - place:
            raise PacketError(f"a part of a bundle has {length} bytes")
        yield from read_osc(data[place : place + int(length)], deepest - 1)
        place += int(length)


def _read_message(data: bytes) -> OscMessage:
    address, place = _text(data, 0)
    if not address.startswith("/"):
        raise PacketError("an address begins with /")
    if place == len(data):  # old senders leave the tags of no arguments out
        return OscMessage(address, ())
    tags, place = _text(data, place)
    if not tags.startswith(","):
        raise PacketError("tags of types begin with a comma")
    found: list[Argument] = []
    for tag in tags[1:]:
        argument: Argument
        if tag in _WORDS:
            argument = _WORDS[tag]
        elif tag in _NUMBERS:
            argument, place = _number(data, place, _NUMBERS[tag])
        elif tag in "sS":
            argument, place = _text(data, place)
        elif tag == "b":
            argument, place = _blob(data, place)
        else:
            raise PacketError(f"arguments of type {tag!r} are not read")
        found.append(argument)
    if place != len(data):
        raise PacketError(f"{len(data) - place} bytes follow the message")
    return OscMessage(address, tuple(found))


def _number(data: bytes, place: int, form: struct.Struct) -> tuple[int | float, int]:
    try:
        return form.unpack_from(data, place)[0], place + form.size
    except struct.error as error:
        raise PacketError("the message ends early") from error


def _text(data: bytes, place: int) -> tuple[str, int]:
    """Return a text, which ends with a zero and fills its last four bytes, and where it ends."""
    end = data.find(b"\0", place)
    if end < 0:
        raise PacketError("a text has no end")
    try:
        return data[place:end].decode(), _aligned(end + 1, data)
    except UnicodeDecodeError as error:
        raise PacketError("a text is not UTF-8") from error


def _blob(data: bytes, place: int) -> tuple[bytes, int]:
    length, place = _number(data, place, _INT)
    if not 0 <= length <= len(data) - place:
        raise PacketError(f"a blob has {length} bytes")
    end = place + int(length)
    return data[place:end], _aligned(end, data)


def _aligned(place: int, data: bytes) -> int:
    """Return the next multiple of four, which is in or just behind the data."""
    place += -place % 4
    if place > len(data):
        raise PacketError("the message ends early")
    return place


def write_osc(messages: Sequence[OscMessage], longest: int = LONGEST) -> Iterator[bytes]:
    """Yield messages as bundles of at most ``longest`` bytes, or of a message that is longer."""
    head = BUNDLE + AT_ONCE
    packet = bytearray(head)
    for message in messages:
        written = _write_message(message)
        if len(packet) > len(head) and len(packet) + _INT.size + len(written) > longest:
            yield bytes(packet)
            packet = bytearray(head)
        packet += _INT.pack(len(written)) + written
    if len(packet) > len(head):
        yield bytes(packet)


def _write_message(message: OscMessage) -> bytes:
    """Return a message's bytes; whole numbers are int32, others float32 but for :class:`Double`."""
    tags = ","
    body = b""
    for argument in message.arguments:
        if isinstance(argument, str):
            tags += "s"
            body += _write_text(argument)
        elif isinstance(argument, int):
            tags += "i"
            body += _INT.pack(argument)
        elif isinstance(argument, float):
            tag = "d" if isinstance(argument, Double) else "f"
            tags += tag
            body += _NUMBERS[tag].pack(argument)
        else:
            raise TypeError(f"{argument!r} is not written")
    return _write_text(message.address) + _write_text(tags) + body


def _write_text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)
