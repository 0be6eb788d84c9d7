"""Reading C3D: points of Intel, DEC and MIPS files, as floats or scaled integers.

A file of C3D has the same fields twice, in its header and in its parameters, and both have fields
too narrow for long takes: frames are counted in 16 bits, or by a float, or by two words. No part of
a damaged file gives itself away. So all that the two hold is tried, and only a layout that fills
the file to its last block is believed; what claims more than the file has is truncated.

The format: www.c3d.org. A block has 512 bytes; the header is the first, parameters and data begin
at blocks that the header names. A frame has x, y, z and a word of residual and cameras for each
point, and analog samples, which are passed over.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import IO, Any

import numpy as np

from solver.errors import Finding, InputError, quote
from solver.scans.markers.readers.raw_take import (
    RawTake,
    TakeEvent,
    TakeOptions,
    check_room,
    choose_rate,
    decode,
    make_finding,
    truncated_error,
    unreadable_error,
)
from solver.surface import Floats

# Processors, whose numbers differ in the order of their bytes and in floats.
INTEL = 84  # the last byte first, IEEE
DEC = 85  # floats of the VAX
MIPS = 86  # the first byte first, IEEE
FULL = 1 << 16  # what 16 bits cannot count
MOST_DIMENSIONS = 7  # of a parameter, as the format has it

Value = np.ndarray | list[str]  # numbers in one row, or texts
BLOCK = 512  # bytes
KEY = 0x50  # the second byte of every C3D
MOST_PARAMETER_BYTES = 8 << 20  # in use are some kB
MOST_EVENTS = 1000  # of a take
CHUNK_BYTES = 8 << 20  # of frames that are read at once

# bytes of the header at which its words are
POINTS = 2  # how many in a frame
ANALOG = 4  # how many numbers in a frame
FIRST = 6  # number of the first frame
LAST = 8  # and of the last
SCALE = 12  # units a step of integers; negative: points are floats
DATA = 16  # block in which they begin
RATE = 20  # frames a second
LONG_LABELS = 298  # byte of the word that says that events have labels of four characters
LONG_LABELS_KEY = 12345  # by this
EVENT_COUNT = 300  # of the header's events
EVENT_TIMES = 304  # floats, s
EVENT_LABELS = 396  # four characters each
MOST_HEADER_EVENTS = 18  # that it has room for


@dataclass(frozen=True)
class _Layout:
    """A place of the data and the content of a frame, of those that a file may mean."""

    start: int  # byte of the first frame
    points: int
    analog: int  # numbers of a frame
    scale: float  # negative: numbers are floats
    frames: int

    @property
    def frame_bytes(self) -> int:
        return (4 if self.scale < 0 else 2) * (4 * self.points + self.analog)

    @property
    def end(self) -> int:
        return self.start + self.frames * self.frame_bytes

    def fills(self, size: int) -> bool:
        """Tell whether a file of so many bytes ends with this layout, or with its last block."""
        return size in (self.end, -(-self.end // BLOCK) * BLOCK)


def read_c3d(path: Path, options: TakeOptions) -> RawTake:
    """Return the points of a C3D file.

    Raises :class:`InputError`: ``markers.unreadable``, ``markers.truncated`` (with ``expected`` and
    ``found`` bytes), ``markers.none`` or ``markers.too_large``.
    """
    file = path.name
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        header, section, numbers = _read_head(file, stream, size)
        parameters = read_parameters(file, section, numbers)
        layout, findings = _find_layout(file, header, parameters, numbers, size)
        check_room(file, layout.frames, layout.points, options)
        points, words = _read_points(file, stream, layout, numbers)
    places = {"its parameters": parameters.number("POINT", "RATE")}
    places["its header"] = numbers.number(header, RATE)
    rates = [(place, rate) for place, rate in places.items() if rate is not None]
    rate, more = choose_rate(file, rates, options)
    start = parameters.long_count("TRIAL", "ACTUAL_START_FIELD")
    return RawTake(
        _labels(parameters)[: layout.points],
        points,
        rate,
        numbers.word(header, FIRST) if start is None else start,
        next(iter(parameters.texts("POINT", "UNITS")), None),
        words * abs(parameters.number("POINT", "SCALE") or layout.scale),
        up=_up(parameters),
        events=_events(header, parameters, numbers),
        findings=findings + more,
    )


def _read_head(file: str, stream: IO[bytes], size: int) -> tuple[bytes, bytes, Numbers]:
    """Return the header, the section of parameters, and how numbers are written."""
    stream.seek(0)
    header = stream.read(BLOCK)
    if size < BLOCK:
        raise truncated_error(
            file, f"{size} bytes are not even a header", expected=BLOCK, found=size
        )
    start = (header[0] - 1) * BLOCK
    if start < BLOCK:
        raise unreadable_error(file, f"its parameters cannot begin at block {header[0]}")
    if start + BLOCK > size:
        reason = f"its parameters begin at byte {start} of {size}"
        raise truncated_error(file, reason, expected=start + BLOCK, found=size)
    stream.seek(start)
    _, _, blocks, processor = stream.read(4)
    if processor not in (INTEL, DEC, MIPS):
        raise unreadable_error(file, f"its processor type {processor} is not known")
    if start + blocks * BLOCK > size:
        reason = f"its parameters take {blocks} blocks from byte {start} on, of {size}"
        raise truncated_error(file, reason, expected=start + blocks * BLOCK, found=size)
    numbers = Numbers(processor)
    # more than 255 blocks of parameters cannot be written: they go on to the data
    end = max(start + blocks * BLOCK, (numbers.word(header, DATA) - 1) * BLOCK)
    return header, stream.read(min(end - start - 4, MOST_PARAMETER_BYTES)), numbers


def _labels(parameters: Parameters) -> list[str]:
    """Return labels of points: no parameter holds more than 255, LABELS2 and so on go on."""
    labels = list(parameters.texts("POINT", "LABELS"))
    for number in range(2, 2 + FULL // 255):
        more = parameters.texts("POINT", f"LABELS{number}")
        if not more:
            break
        labels += more
    return labels


def _up(parameters: Parameters) -> str | None:
    """Return the axis that points up the screen, as x, -x and so on."""
    axis = next(iter(parameters.texts("POINT", "Y_SCREEN")), "").lower().removeprefix("+")
    return axis if axis.removeprefix("-") in ("x", "y", "z") else None


def _find_layout(
    file: str, header: bytes, parameters: Parameters, numbers: Numbers, size: int
) -> tuple[_Layout, list[Finding]]:
    """Return the one layout that the file's size agrees with, and findings about it."""
    scales = parameters.number("POINT", "SCALE"), numbers.number(header, SCALE)
    choices: list[list[Any]] = [
        _drop_repeats(parameters.count("POINT", "DATA_START"), numbers.word(header, DATA)),
        _drop_repeats(parameters.count("POINT", "USED"), numbers.word(header, POINTS)),
        _drop_repeats(_analog(parameters), numbers.word(header, ANALOG)),
        _drop_repeats(*map(_scale, scales)),
        _frame_counts(header, parameters, numbers),
    ]
    layouts = [
        _Layout((block - 1) * BLOCK, *rest)
        for block, *rest in product(*choices)
        if block > header[0]
    ]
    if not layouts:
        raise unreadable_error(file, "it lacks the fields of where points are, or of which kind")
    layouts = [layout for layout in layouts if layout.points and layout.frames]
    if not layouts:
        what = "frames" if any(choices[1]) else "points"
        raise InputError("markers.none", f"{file} has no {what}", file=file)
    filling = [layout for layout in layouts if layout.fills(size)]
    if len(filling) > 1:
        raise unreadable_error(
            file, "header and parameters contradict each other, and both may be true"
        )
    return (filling[0], []) if filling else _accept_longer(file, layouts, size)


def _accept_longer(
    file: str, layouts: Sequence[_Layout], size: int
) -> tuple[_Layout, list[Finding]]:
    """Return the layout of a file that has more than its fields say; raise if it has less."""
    for each in layouts:
        # a count of 16 bits that has overflowed, or that stands at its end: what is behind the last
        # frame in its block then looks like frames without points
        held = (size - each.start) // each.frame_bytes
        count = held if each.frames == FULL - 1 else held - (held - each.frames) % FULL
        longer = replace(each, frames=count)
        if count >= FULL and longer.fills(size):
            message = f"{file} says {each.frames} frames and holds {count}, which are read."
            return longer, [
                make_finding("markers.header", "warning", message, file=file, found=count)
            ]
    first = layouts[0]
    if first.end > size:
        reason = f"{first.frames} frames of {first.points} points end at byte {first.end} of {size}"
        raise truncated_error(file, reason, expected=first.end, found=size)
    if len(layouts) > 1:
        raise unreadable_error(
            file, "header and parameters contradict each other, and neither fits it"
        )
    if size % BLOCK:  # bytes in its midst may be lost or too many, and all after them wrong
        reason = f"its data end at byte {first.end}, and it does after {size}, which ends no block"
        raise unreadable_error(file, reason, expected=first.end, found=size)
    message = f"{file} has {size - first.end} bytes after its last frame, which are not read."
    return first, [
        make_finding(
            "markers.header", "warning", message, file=file, found=size, expected=first.end
        )
    ]


def _drop_repeats(*values: Any) -> list[Any]:
    return list(dict.fromkeys(value for value in values if value is not None))


def _scale(scale: float | None) -> float | None:
    """Return a scale that can be; all negative ones alike mean that numbers are floats."""
    if scale is None or not math.isfinite(scale) or scale == 0:
        return None
    return -1.0 if scale < 0 else scale


def _analog(parameters: Parameters) -> int | None:
    """Return analog numbers of a frame by the parameters."""
    channels = parameters.count("ANALOG", "USED")
    rate = parameters.number("ANALOG", "RATE")
    points = parameters.number("POINT", "RATE")
    if not channels:
        return channels
    if not rate or not points or not math.isfinite(rate / points):
        return None
    return channels * max(round(rate / points), 0)


def _frame_counts(header: bytes, parameters: Parameters, numbers: Numbers) -> list[int]:
    """Return the numbers of frames in the file's fields, the surest first."""
    fields = [parameters.long_count("TRIAL", f"ACTUAL_{end}_FIELD") for end in ("START", "END")]
    start, end = fields
    counts = _drop_repeats(
        None if start is None or end is None else end - start + 1,
        parameters.count("POINT", "LONG_FRAMES"),
        parameters.count("POINT", "FRAMES"),
        numbers.word(header, LAST) - numbers.word(header, FIRST) + 1,
    )
    return [count for count in counts if count >= 0]


def _read_points(
    file: str, stream: IO[bytes], layout: _Layout, numbers: Numbers
) -> tuple[Floats, Floats]:
    """Return points (f, n, 3) in the file's units and words of residual (f, n), NaN if missing."""
    points = np.empty((layout.frames, layout.points, 3))
    residual = np.empty((layout.frames, layout.points))
    read, factor = (numbers.floats, 1.0) if layout.scale < 0 else (numbers.words, layout.scale)
    stream.seek(layout.start)
    step = max(1, CHUNK_BYTES // layout.frame_bytes)
    for start in range(0, layout.frames, step):
        here = slice(start, min(start + step, layout.frames))
        count = len(residual[here])
        content = stream.read(count * layout.frame_bytes)
        if len(content) < count * layout.frame_bytes:
            raise truncated_error(file, f"frame {start + count} of it is not whole")
        table = read(content).reshape(count, -1)[:, : 4 * layout.points].reshape(count, -1, 4)
        with np.errstate(invalid="ignore"):  # signalling NaN
            points[here] = table[..., :3]
            word = np.nan_to_num(table[..., 3].astype(float), nan=-1.0, posinf=-1.0, neginf=-1.0)
        points[here] *= factor
        word = np.clip(word, -1.0, FULL // 2 - 1).astype(np.int16)
        is_missing = (word < 0) | ~np.isfinite(points[here]).all(axis=-1)
        is_missing |= ~points[here].any(axis=-1)  # exactly 0, 0, 0
        points[here][is_missing] = np.nan
        residual[here] = np.where(is_missing, np.nan, word & 0xFF)  # the high byte has the cameras
    return points, residual


def _events(header: bytes, parameters: Parameters, numbers: Numbers) -> tuple[TakeEvent, ...]:
    """Return the events of the group EVENT, or else those of the header."""
    labels = parameters.texts("EVENT", "LABELS")
    contexts = parameters.texts("EVENT", "CONTEXTS")
    times = parameters.numbers("EVENT", "TIMES")
    seconds = [60 * minutes + rest for minutes, rest in zip(times[::2], times[1::2], strict=False)]
    if not seconds and numbers.word(header, LONG_LABELS) == LONG_LABELS_KEY:
        count = min(numbers.word(header, EVENT_COUNT), MOST_HEADER_EVENTS)
        seconds = numbers.floats(header[EVENT_TIMES : EVENT_TIMES + 4 * count]).tolist()
        names = header[EVENT_LABELS : EVENT_LABELS + 4 * count]
        labels = [decode(names[at : at + 4]) for at in range(0, 4 * count, 4)]
        contexts = []
    found = []
    for number, time in enumerate(seconds[:MOST_EVENTS]):
        words = [*contexts[number : number + 1], *labels[number : number + 1]]
        if math.isfinite(time):
            found.append(TakeEvent(quote(" ".join(filter(None, words))), float(time)))
    return tuple(found)


# Parameters: groups of named numbers and texts, as the processor that wrote them does. They are a
# chain of records. A record has the lengths of its name and the number of its group (negative: the
# record is the group itself), the name, how far it is to the next record, and its content: type,
# dimensions, values, a description.


@dataclass(frozen=True)
class Numbers:
    """Numbers as a processor writes them."""

    processor: int

    @property
    def order(self) -> str:
        """Return the order of bytes as :mod:`struct` has it."""
        return ">" if self.processor == MIPS else "<"

    def words(self, content: bytes) -> np.ndarray:
        """Return words of 16 bits with their signs."""
        return np.frombuffer(content, f"{self.order}i2")

    def word(self, content: bytes, place: int) -> int:
        """Return one word without a sign."""
        return int(struct.unpack_from(f"{self.order}H", content, place)[0])

    def floats(self, content: bytes) -> np.ndarray:
        """Return float32; a VAX's have the high word first and an exponent that is two more."""
        if self.processor != DEC:
            return np.frombuffer(content, f"{self.order}f4").astype(np.float32)
        words = np.frombuffer(content, "<u2").astype(np.uint32)
        bits = (words[0::2] << 16) | words[1::2]
        with np.errstate(all="ignore"):
            return np.where(bits & 0x7F800000, bits.view(np.float32) / 4, np.float32(0.0))

    def number(self, content: bytes, place: int) -> float:
        """Return one float."""
        return float(self.floats(content[place : place + 4])[0])


@dataclass(frozen=True)
class Parameters:
    """Values by the names of group and parameter."""

    values: Mapping[tuple[str, str], Value]

    def texts(self, group: str, name: str) -> list[str]:
        """Return texts; none if there is no such parameter, or it has numbers."""
        value = self.values.get((group, name))
        return value if isinstance(value, list) else []

    def numbers(self, group: str, name: str) -> list[float]:
        """Return numbers; none if there is no such parameter, or it has texts."""
        value = self.values.get((group, name))
        return value.astype(float).tolist() if isinstance(value, np.ndarray) else []

    def number(self, group: str, name: str) -> float | None:
        """Return the first number, if there is one."""
        return next(iter(self.numbers(group, name)), None)

    def count(self, group: str, name: str) -> int | None:
        """Return a count: an integer, which has no sign whatever the format says, or a float."""
        value = self.values.get((group, name))
        number = self.number(group, name)
        if number is None or not isinstance(value, np.ndarray):
            return None
        if value.dtype.kind == "i":
            return int(number) % (1 << 8 * value.dtype.itemsize)
        return int(number) if math.isfinite(number) and number >= 0 else None

    def long_count(self, group: str, name: str) -> int | None:
        """Return a count that takes two words, the low one first."""
        words = self.numbers(group, name)
        if len(words) < 2 or not all(map(math.isfinite, words)):
            return None
        return int(words[0]) % FULL + FULL * (int(words[1]) % FULL)


def read_parameters(file: str, section: bytes, numbers: Numbers) -> Parameters:
    """Return what a file's section of parameters says.

    Raises :class:`InputError` (``markers.unreadable``) for a chain that is broken.
    """
    groups: dict[int, str] = {}
    found: dict[tuple[int, str], Value] = {}
    try:
        for number, name, record in _records(section, numbers):
            if number < 0:
                groups[-number] = name
            else:
                found.setdefault((number, name), _value(record, numbers))
    except (ValueError, struct.error) as error:
        raise unreadable_error(file, f"its parameters are damaged: {error}") from error
    return Parameters(
        {(groups.get(group, ""), name): value for (group, name), value in found.items()}
    )


def _records(section: bytes, numbers: Numbers) -> Iterator[tuple[int, str, bytes]]:
    """Give the number of the group, the name and the content of each record."""
    place = 0
    while place + 2 <= len(section):
        length, number = struct.unpack_from("bb", section, place)
        if not length or not number:
            return
        start = place + 2 + abs(length)  # a locked one has a negative length
        name = section[place + 2 : start].decode("latin-1")
        if not name.isascii() or not name.isprintable():
            raise ValueError(f"'{quote(name)}' is no name")
        step = struct.unpack_from(f"{numbers.order}h", section, start)[0]
        place = start + step if step else len(section)
        if step < 0 or place > len(section):
            raise ValueError(f"{quote(name)} is longer than all of them")
        yield number, name.strip().upper(), section[start + 2 : place]


def _value(record: bytes, numbers: Numbers) -> Value:
    """Return the value of a parameter by its content."""
    kind, dimensions = struct.unpack_from("bB", record)
    shape = record[2 : 2 + dimensions]
    if dimensions > MOST_DIMENSIONS or len(shape) < dimensions:
        raise ValueError(f"a parameter has {dimensions} dimensions")
    if kind not in (-1, 1, 2, 4):
        raise ValueError(f"a parameter is of type {kind}")
    count = math.prod(shape)
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
