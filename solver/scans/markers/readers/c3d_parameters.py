"""Parameters of a C3D: groups of named numbers and texts, as the processor that wrote them does.

They are a chain of records. A record has the lengths of its name and the number of its group
(negative: the record is the group itself), the name, how far it is to the next record, and its
content: type, dimensions, values, a description.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from solver.errors import quote
from solver.scans.markers.readers.raw_take import decode, unreadable_error

INTEL, DEC, MIPS = 84, 85, 86  # processors, whose numbers differ in order and in floats
FULL = 1 << 16  # what 16 bits cannot count
MOST_DIMENSIONS = 7  # of a parameter, as the format has it

Value = np.ndarray | list[str]  # numbers in one row, or texts


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
        value, number = self.values.get((group, name)), self.number(group, name)
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
