"""Reading C3D: points of Intel, DEC and MIPS files, as floats or scaled integers.

A file of C3D says the same things twice, in its header and in its parameters, and both have fields
too narrow for long takes: frames are counted in 16 bits, or by a float, or by two words. No part of
a damaged file gives itself away. So all that the two say is tried, and only a layout that fills the
file to its last block is believed; what claims more than the file has is truncated.

The format: www.c3d.org. A block has 512 bytes; the header is the first, parameters and data begin
at blocks that the header names. A frame has x, y, z and a word of residual and cameras for each
point, and analog samples, which are passed over.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import IO, Any

import numpy as np

from solver.errors import Finding, InputError, quote
from solver.scans.markers.raw_take import (
    Event,
    RawTake,
    TakeOptions,
    check_room,
    choose_rate,
    decode,
    tell,
    truncated,
    unreadable,
)

BLOCK = 512  # bytes
KEY = 0x50  # the second byte of every C3D
MOST_PARAMETER_BYTES = 8 << 20
MOST_EVENTS = 1000
CHUNK_BYTES = 8 << 20  # of frames that are read at once
INTEL, DEC, MIPS = 84, 85, 86  # processors, whose numbers differ in order and in floats
FULL = 1 << 16  # what 16 bits cannot count

# words of the header, by their bytes
POINTS, ANALOG, FIRST, LAST, SCALE, DATA, RATE = 2, 4, 6, 8, 12, 16, 20
EVENT_COUNT, EVENT_TIMES, EVENT_FLAGS, EVENT_LABELS, MOST_HEADER_EVENTS = 300, 304, 376, 396, 18
LONG_LABELS, LONG_LABELS_KEY = 298, 12345  # events have labels of four characters

Value = np.ndarray | list[str]  # of a parameter: numbers in one row, or text


@dataclass(frozen=True)
class _Numbers:
    """How a processor writes numbers."""

    processor: int

    @property
    def order(self) -> str:
        return ">" if self.processor == MIPS else "<"

    def words(self, content: bytes) -> np.ndarray:
        return np.frombuffer(content, f"{self.order}i2")

    def word(self, content: bytes, place: int) -> int:
        return int(struct.unpack_from(f"{self.order}H", content, place)[0])

    def floats(self, content: bytes) -> np.ndarray:
        """Return float32 of bytes; VAX's have the high word first and a bias of 2 more."""
        if self.processor != DEC:
            return np.frombuffer(content, f"{self.order}f4").astype(np.float32)
        words = np.frombuffer(content, "<u2").astype(np.uint32)
        bits = (words[0::2] << 16) | words[1::2]
        return np.where(bits & 0x7F800000, bits.view(np.float32) / 4, np.float32(0.0))

    def number(self, content: bytes, place: int) -> float:
        return float(self.floats(content[place : place + 4])[0])


@dataclass(frozen=True)
class _Layout:
    """Where the data are and what a frame has: of what a file says, one that may be true."""

    start: int  # byte of the first frame
    points: int
    analog: int  # numbers of a frame
    scale: float  # negative: numbers are floats
    frames: int

    @property
    def size(self) -> int:
        """Return the bytes of a number."""
        return 4 if self.scale < 0 else 2

    @property
    def frame_bytes(self) -> int:
        return self.size * (4 * self.points + self.analog)

    @property
    def end(self) -> int:
        return self.start + self.frames * self.frame_bytes

    def fills(self, size: int) -> bool:
        """Tell whether a file of so many bytes ends with this layout's last block."""
        return 0 <= size - self.end < BLOCK


def read_c3d(path: Path, options: TakeOptions) -> RawTake:
    """Return the points of a C3D file.

    Raises :class:`InputError`: ``markers.unreadable``, ``markers.truncated`` (with ``expected`` and
    ``found`` bytes), ``markers.none`` or ``markers.too_large``.
    """
    file = path.name
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        header, section, numbers = _read_head(file, stream, size)
        said = _read_parameters(file, section, numbers)
        layout, findings = _find_layout(file, header, said, numbers, size)
        check_room(file, layout.frames, layout.points, options)
        points, words = _read_points(file, stream, layout, numbers)
    places = [("its parameters", _number(said, "POINT", "RATE"))]
    places += [("its header", numbers.number(header, RATE))]
    rate, more = choose_rate(file, [(at, hz) for at, hz in places if hz is not None], options)
    return RawTake(
        _labels(said)[: layout.points],
        points,
        rate,
        _first_frame(header, said, numbers),
        next(iter(_texts(said, "POINT", "UNITS")), None),
        words * abs(_number(said, "POINT", "SCALE") or layout.scale),
        up=_up(said),
        events=_events(header, said, numbers),
        findings=findings + more,
    )


def _read_head(file: str, stream: IO[bytes], size: int) -> tuple[bytes, bytes, _Numbers]:
    """Return the header, the section of parameters, and how numbers are written."""
    stream.seek(0)
    header = stream.read(BLOCK)
    if len(header) < 2 or header[1] != KEY:
        raise unreadable(file, "it is not a C3D file")
    if size < BLOCK:
        raise truncated(file, f"{size} bytes are not even a header", expected=BLOCK, found=size)
    start = (header[0] - 1) * BLOCK
    if start < BLOCK:
        raise unreadable(file, f"its parameters cannot begin at block {header[0]}")
    if start + BLOCK > size:
        reason = f"its parameters begin at byte {start} of {size}"
        raise truncated(file, reason, expected=start + BLOCK, found=size)
    stream.seek(start)
    _, _, blocks, processor = stream.read(4)
    if processor not in (INTEL, DEC, MIPS):
        raise unreadable(file, f"its processor type {processor} is not known")
    numbers = _Numbers(processor)
    # more than 255 blocks of parameters cannot be said: they go on to the data
    end = max(start + blocks * BLOCK, (numbers.word(header, DATA) - 1) * BLOCK)
    end = min(end, size, start + MOST_PARAMETER_BYTES)
    if start + blocks * BLOCK > size:
        reason = f"its parameters take {blocks} blocks from byte {start}"
        raise truncated(file, reason, expected=start + blocks * BLOCK, found=size)
    return header, stream.read(end - start - 4), numbers


# Parameters: a chain of records, groups and what belongs to them.


def _read_parameters(
    file: str, section: bytes, numbers: _Numbers
) -> Mapping[tuple[str, str], Value]:
    """Return values by the names of group and parameter."""
    groups: dict[int, str] = {}
    found: dict[tuple[int, str], Value] = {}
    try:
        for number, name, record in _records(section, numbers):
            if number < 0:
                groups[-number] = name
            else:
                found.setdefault((number, name), _value(record, numbers))
    except (IndexError, ValueError, struct.error) as error:
        raise unreadable(file, f"its parameters are damaged: {error}") from error
    return {(groups.get(group, ""), name): value for (group, name), value in found.items()}


def _records(section: bytes, numbers: _Numbers) -> Iterator[tuple[int, str, bytes]]:
    """Give group number (negative: the record is the group itself), name and content of each."""
    place = 0
    while place + 2 <= len(section):
        length, number = struct.unpack_from("bb", section, place)
        if not length or not number:
            return
        start = place + 2 + abs(length)  # a locked one has a negative length
        name = section[place + 2 : start]
        if not name.isascii() or not name.decode("ascii").isprintable():
            raise ValueError(f"'{quote(name.decode('latin-1'))}' is no name")
        step = struct.unpack_from(f"{numbers.order}h", section, start)[0]
        place = start + step if step else len(section)
        if step < 0 or place > len(section):
            raise ValueError(f"{quote(name.decode('ascii'))} is longer than all of them")
        yield number, name.decode("ascii").strip().upper(), section[start + 2 : place]


def _value(record: bytes, numbers: _Numbers) -> Value:
    """Return the value of a parameter: its type, its dimensions, its numbers or characters."""
    kind, dimensions = struct.unpack_from("bB", record)
    shape = record[2 : 2 + dimensions]
    if dimensions > 7 or len(shape) < dimensions:
        raise ValueError(f"a parameter has {dimensions} dimensions")
    count = math.prod(shape)
    if kind not in (-1, 1, 2, 4):
        raise ValueError(f"a parameter is of type {kind}")
    content = record[2 + dimensions : 2 + dimensions + count * abs(kind)]
    if len(content) < count * abs(kind):
        raise ValueError(f"a parameter needs {count * abs(kind)} bytes and has {len(content)}")
    if kind == 4:
        return numbers.floats(content)
    if kind == 2:
        return numbers.words(content)
    if kind == 1:
        return np.frombuffer(content, np.int8)
    width = shape[0] if shape else 1
    return [decode(content[at : at + width]) for at in range(0, count, width)] if count else []


def _numbers_of(said: Mapping[tuple[str, str], Value], group: str, name: str) -> list[float]:
    value = said.get((group, name))
    return value.astype(float).tolist() if isinstance(value, np.ndarray) else []


def _number(said: Mapping[tuple[str, str], Value], group: str, name: str) -> float | None:
    return next(iter(_numbers_of(said, group, name)), None)


def _count(said: Mapping[tuple[str, str], Value], group: str, name: str) -> int | None:
    """Return a count: 16 bits without a sign, whatever the format says, or a float."""
    value = said.get((group, name))
    if not isinstance(value, np.ndarray) or not len(value):
        return None
    number = float(value[0])
    if value.dtype.kind == "i":
        return int(number) % FULL if value.dtype.itemsize == 2 else int(number) % 256
    return int(number) if math.isfinite(number) and number >= 0 else None


def _texts(said: Mapping[tuple[str, str], Value], group: str, name: str) -> list[str]:
    value = said.get((group, name))
    return value if isinstance(value, list) else []


def _labels(said: Mapping[tuple[str, str], Value]) -> list[str]:
    """Return labels of points: no parameter holds more than 255, LABELS2 and so on go on."""
    labels = list(_texts(said, "POINT", "LABELS"))
    for number in range(2, 2 + FULL // 255):
        more = _texts(said, "POINT", f"LABELS{number}")
        if not more:
            break
        labels += more
    return labels


def _up(said: Mapping[tuple[str, str], Value]) -> str | None:
    """Return the axis that points up the screen, as x, -x and so on."""
    axis = next(iter(_texts(said, "POINT", "Y_SCREEN")), "").lower().removeprefix("+")
    return axis if axis.removeprefix("-") in ("x", "y", "z") else None


# Where the data are.


def _find_layout(
    file: str, header: bytes, said: Mapping[tuple[str, str], Value], numbers: _Numbers, size: int
) -> tuple[_Layout, list[Finding]]:
    """Return the one layout that the file's size agrees with, and what is to be told of it."""
    scales = [_number(said, "POINT", "SCALE"), numbers.number(header, SCALE)]
    choices: list[list[Any]] = [
        _distinct(_count(said, "POINT", "DATA_START"), numbers.word(header, DATA)),
        _distinct(_count(said, "POINT", "USED"), numbers.word(header, POINTS)),
        _distinct(_analog(said), numbers.word(header, ANALOG)),
        _distinct(*(_scale(scale) for scale in scales)),
        _frame_counts(header, said, numbers),
    ]
    if not all(choices):
        raise unreadable(file, "header and parameters do not say where points are, or how many")
    layouts = [
        _Layout((block - 1) * BLOCK, *rest)
        for block, *rest in product(*choices)
        if block > header[0]
    ]
    if not any(layout.points for layout in layouts):
        raise InputError("markers.none", f"{file} has no points", file=file)
    layouts = [layout for layout in layouts if layout.points and layout.frames]
    if not layouts:
        raise InputError("markers.none", f"{file} has no frames", file=file)
    filling = [layout for layout in layouts if layout.fills(size)]
    if len(filling) == 1:
        return filling[0], []
    if filling:
        raise unreadable(file, "header and parameters contradict each other, and both may be true")
    return _overfull(file, layouts, size)


def _overfull(file: str, layouts: list[_Layout], size: int) -> tuple[_Layout, list[Finding]]:
    """Return the layout of a file that has more than it says; raise if it has less."""
    for each in layouts:
        held = (size - each.start) // each.frame_bytes
        # a count of 16 bits that has overflowed, or that stands at its end
        is_wrapped = held >= FULL and each.frames in (held % FULL, FULL - 1)
        layout = _Layout(each.start, each.points, each.analog, each.scale, held)
        if is_wrapped and layout.fills(size):
            message = f"{file} says {each.frames} frames and holds {held}, which are read."
            return layout, [tell("header", "warning", message, file=file, found=held)]
    least = min(layouts, key=lambda layout: layout.end)
    most = layouts[0]
    if size < most.end:
        reason = f"{most.frames} frames of {most.points} points end at byte {most.end} of {size}"
        raise truncated(file, reason, expected=most.end, found=size)
    if len(layouts) > 1:
        raise unreadable(file, "header and parameters contradict each other, and neither fits it")
    message = f"{file} has {size - least.end} bytes after its last frame, which are not read."
    return least, [tell("header", "warning", message, file=file, found=size, expected=least.end)]


def _distinct(*values: Any) -> list[Any]:
    return list(dict.fromkeys(value for value in values if value is not None))


def _scale(scale: float | None) -> float | None:
    """Return a scale that can be; all negative ones only say that numbers are floats."""
    if scale is None or not math.isfinite(scale) or scale == 0:
        return None
    return -1.0 if scale < 0 else scale


def _analog(said: Mapping[tuple[str, str], Value]) -> int | None:
    """Return analog numbers of a frame by the parameters."""
    channels = _count(said, "ANALOG", "USED")
    rate, points = _number(said, "ANALOG", "RATE"), _number(said, "POINT", "RATE")
    if not channels:
        return channels
    if not rate or not points or not math.isfinite(rate / points):
        return None
    return channels * max(round(rate / points), 0)


def _frame_counts(
    header: bytes, said: Mapping[tuple[str, str], Value], numbers: _Numbers
) -> list[int]:
    """Return the numbers of frames that places of the file say, the surest first."""
    start, end = (_field(said, f"ACTUAL_{name}_FIELD") for name in ("START", "END"))
    by_trial = None if start is None or end is None else end - start + 1
    in_header = numbers.word(header, LAST) - numbers.word(header, FIRST) + 1
    counts = _distinct(
        by_trial, _count(said, "POINT", "LONG_FRAMES"), _count(said, "POINT", "FRAMES"), in_header
    )
    return [count for count in counts if count >= 0]


def _field(said: Mapping[tuple[str, str], Value], name: str) -> int | None:
    """Return a frame's number that takes two words, the low one first."""
    words = _numbers_of(said, "TRIAL", name)
    if len(words) < 2 or not all(map(math.isfinite, words)):
        return None
    return int(words[0]) % FULL + FULL * (int(words[1]) % FULL)


def _first_frame(header: bytes, said: Mapping[tuple[str, str], Value], numbers: _Numbers) -> int:
    start = _field(said, "ACTUAL_START_FIELD")
    return numbers.word(header, FIRST) if start is None else start


# Frames and events.


def _read_points(
    file: str, stream: IO[bytes], layout: _Layout, numbers: _Numbers
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (f, n, 3) in the file's units and words of residual (f, n), NaN if missing."""
    points = np.empty((layout.frames, layout.points, 3))
    residual = np.empty((layout.frames, layout.points))
    stream.seek(layout.start)
    step = max(1, CHUNK_BYTES // layout.frame_bytes)
    for start in range(0, layout.frames, step):
        here = slice(start, min(start + step, layout.frames))
        count = len(residual[here])
        content = stream.read(count * layout.frame_bytes)
        if len(content) < count * layout.frame_bytes:
            raise truncated(file, f"frame {start + count} is not whole")
        values = numbers.floats(content) if layout.size == 4 else numbers.words(content)
        table = values.reshape(count, -1)[:, : 4 * layout.points].reshape(count, -1, 4)
        with np.errstate(invalid="ignore"):  # signalling NaN
            points[here] = table[..., :3] if layout.size == 4 else table[..., :3] * layout.scale
            word = np.nan_to_num(table[..., 3].astype(float), nan=-1.0, posinf=-1.0, neginf=-1.0)
        word = np.clip(word, -1.0, FULL // 2 - 1).astype(np.int16)
        is_missing = (word < 0) | ~np.isfinite(points[here]).all(axis=-1)
        is_missing |= ~points[here].any(axis=-1)
        points[here][is_missing] = np.nan
        residual[here] = np.where(is_missing, np.nan, word & 0xFF)
    return points, residual


def _events(
    header: bytes, said: Mapping[tuple[str, str], Value], numbers: _Numbers
) -> tuple[Event, ...]:
    """Return the events of the group EVENT, or else those of the header."""
    labels = _texts(said, "EVENT", "LABELS")
    times = _numbers_of(said, "EVENT", "TIMES")
    contexts = _texts(said, "EVENT", "CONTEXTS")
    pairs = zip(times[0::2], times[1::2], strict=False)
    seconds = [60.0 * minutes + rest for minutes, rest in pairs]
    if not seconds and numbers.word(header, LONG_LABELS) == LONG_LABELS_KEY:
        count = min(numbers.word(header, EVENT_COUNT), MOST_HEADER_EVENTS)
        seconds = numbers.floats(header[EVENT_TIMES : EVENT_TIMES + 4 * count]).tolist()
        names = header[EVENT_LABELS : EVENT_LABELS + 4 * count]
        labels, contexts = [decode(names[at : at + 4]) for at in range(0, 4 * count, 4)], []
    found = []
    for number, time in enumerate(seconds[:MOST_EVENTS]):
        names_of = [*contexts[number : number + 1], *labels[number : number + 1]]
        if math.isfinite(time):
            found.append(Event(quote(" ".join(filter(None, names_of))), float(time)))
    return tuple(found)
