"""What a source has seen at a moment, and the numbers of the frame that a session takes for it."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan
from sys import byteorder
from typing import Any

Value = float | Sequence[float] | None  # a weight, a place in mm, or what was not seen


class ReadingError(ValueError):
    """What came is no frame."""


@dataclass(frozen=True)
class Reading:
    """A frame at a source: its time in s by the source's clock, and what was seen.

    Values are weights or places by name, a row each in the session's order, or a frame's bytes.
    """

    seconds: float
    values: Mapping[str, Value] | Sequence[Value] | bytes


@dataclass(frozen=True)
class Expected:
    """What a session takes as a frame: rows of ``width`` numbers (1: weights, 3: places in mm)."""

    rows: int
    width: int
    labels: tuple[str, ...] = ()  # (rows,), or none where rows have no names

    @classmethod
    def of(cls, ready: Mapping[str, Any]) -> Expected:
        """Return what the session's ready message says."""
        said = ready["expects"]
        return cls(said["rows"], said["width"], tuple(said.get("labels") or ()))

    def numbers(self, reading: Reading) -> bytes:
        """Return a reading as a frame's numbers, float32 by rows, NaN for what was not seen.

        Names that the session does not know are left out. Raises :class:`ReadingError` for another
        number of rows, a value of another form, or names where the session knows none.
        """
        values = reading.values
        if isinstance(values, bytes):
            if len(values) != 4 * self.rows * self.width:
                wanted = 4 * self.rows * self.width
                raise ReadingError(f"a frame has {len(values)} bytes, and {wanted} are expected")
            return values
        if isinstance(values, Mapping):
            if not self.labels:
                raise ReadingError("the session's rows have no names: give them in their order")
            rows: Sequence[Value] = [values.get(label) for label in self.labels]
        else:
            rows = values
        if len(rows) != self.rows:
            raise ReadingError(f"a frame has {len(rows)} rows, and {self.rows} are expected")
        return pack_numbers([number for row in rows for number in self._row(row)])

    def _row(self, value: Value) -> Sequence[float]:
        if value is None:
            return [nan] * self.width
        row = [value] if isinstance(value, int | float) else value
        if len(row) != self.width or not all(isinstance(each, int | float) for each in row):
            form = "a weight" if self.width == 1 else "a place [x, y, z]"
            raise ReadingError(f"{value!r} is not {form}")
        return row


def pack_numbers(numbers: Sequence[float]) -> bytes:
    """Return numbers as little-endian float32; raises :class:`ReadingError` for greater ones."""
    try:
        packed = array("f", numbers)
    except (OverflowError, TypeError) as error:
        raise ReadingError(str(error)) from error
    if byteorder == "big":
        packed.byteswap()
    return packed.tobytes()


def unpack_numbers(data: bytes) -> Sequence[float]:
    """Return the float32 numbers in little-endian ``data``."""
    numbers = array("f", data)
    if byteorder == "big":
        numbers.byteswap()
    return numbers
