"""Read what is known of single muscles: a table that lies beside scans, a performance or a take.

Each row of the CSV says of one muscle, in one expression or at one time, by which part of their
length its fibres have shortened, and how surely: channels of surface EMG, filtered and scaled to a
stated maximum, or what an animator pins. Between the times of a muscle its values are interpolated
linearly; before its first and after its last nothing is known of it. The columns stand in
``docs/guide/known-activations.md``.
"""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np

from solver.drawing.head import both_sides, muscle_side
from solver.errors import file_error, quote, quote_names
from solver.model import tell_muscles
from solver.surface import Floats, Ints

NEEDED = ("muscle", "value", "sd")
PLACES = ("time", "expression")
# columns of numbers -> the code of an error in one
NUMBERS = {"time": "activations.time", "value": "activations.value", "sd": "activations.sd"}
COLUMNS = (NEEDED[0], "side", *PLACES, *NEEDED[1:])
SIDES: Mapping[str, Literal["", "left", "right"]] = {
    "": "",
    "left": "left",
    "l": "left",
    "right": "right",
    "r": "right",
}


@dataclass(frozen=True)
class KnownTableOptions:
    """Bounds of a table."""

    most_bytes: int = 32 * 2**20
    most_rows: int = 500_000  # an hour of eight channels, of which filtered EMG needs 15 a second
    longest_line: int = 10_000  # characters
    longest_field: int = 200
    most: float = 1.0  # contraction, of fibres that have lost all of their length
    least: float = -1.0  # of fibres that are twice as long
    # of a frame, by which a channel holds on before its first time and after its last
    beside: float = 0.5


@dataclass(frozen=True)
class KnownMuscles:
    """Known contractions of r muscles at one time: ``values`` (r,) with their ``sd`` (r,).

    A name is a muscle's, or that of a whole whose compartments contract by it on average.
    """

    names: tuple[str, ...]
    values: Floats
    sd: Floats

    def __len__(self) -> int:
        return len(self.names)


NOTHING = KnownMuscles((), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class _Channel:
    """All rows of one muscle, in the order of time."""

    name: str
    times: Floats
    values: Floats
    sd: Floats


@dataclass(frozen=True)
class KnownCourse:
    """Known contractions over the time of a take, frames being ``seconds`` apart."""

    channels: tuple[_Channel, ...]
    seconds: float
    options: KnownTableOptions = field(default_factory=KnownTableOptions)

    def at(self, time: float) -> KnownMuscles:
        """Return what is known at a time, s."""
        beside = self.options.beside * self.seconds
        found = [
            each
            for each in self.channels
            if each.times[0] - beside <= time <= each.times[-1] + beside
        ]
        if not found:
            return NOTHING
        values, sd = (
            np.array([np.interp(time, each.times, getattr(each, name)) for each in found])
            for name in ("values", "sd")
        )
        return KnownMuscles(tuple(each.name for each in found), values, sd)


@dataclass(frozen=True)
class KnownTable:
    """The rows of a table: r of them, each of the muscle with a number in ``names``."""

    file: str
    names: tuple[str, ...]
    muscles: Ints  # (r,)
    values: Floats  # (r,)
    sd: Floats  # (r,)
    lines: Ints  # (r,) of the file, counted from 1
    times: Floats | None  # (r,) s; None in a table without times
    expressions: tuple[str, ...] | None  # (r,); None in a table without expressions
    options: KnownTableOptions

    def of_expressions(self, captures: Sequence[str]) -> dict[str, KnownMuscles]:
        """Return capture -> what is known of it; a row without a name is of the only capture.

        Raises :class:`InputError`: ``activations.columns`` for a table of times,
        ``activations.expression`` for a capture that there is not, ``activations.duplicate``.
        """
        if self.times is not None:
            self._fail_of_columns("it has times: scans have names, in the column expression")
        named = [""] * len(self.lines) if self.expressions is None else self.expressions
        rows: dict[str, dict[int, int]] = {}
        for row, given in enumerate(named):
            capture = captures[0] if not given and len(captures) == 1 else given
            if capture not in captures:
                self._fail_of_expression(row, capture, captures)
            before = rows.setdefault(capture, {})
            if (muscle := int(self.muscles[row])) in before:
                self._fail_of_twice(before[muscle], row, f"in {quote(capture)}")
            before[muscle] = row
        return {capture: self._at([*found.values()]) for capture, found in rows.items()}

    def of_take(self, frames: int, rate: float) -> KnownCourse:
        """Return what is known over a take of ``frames`` at ``rate``, whose first is at 0 s.

        Raises :class:`InputError`: ``activations.columns`` for a table without times,
        ``activations.time`` for one outside the take, ``activations.duplicate``.
        """
        times = self.times
        if times is None:
            self._fail_of_columns("it has no column time, seconds from the take's first frame")
        end = frames / rate
        if len(beyond := np.flatnonzero((times < 0.0) | (times > end))):
            row = int(beyond[0])
            message = f"time {times[row]:g} s is outside the take, which lasts {end:g} s"
            self._fail(row, "activations.time", message, expected=end, found=float(times[row]))
        order = np.lexsort((times, self.muscles))
        same = np.diff(self.muscles[order]) == 0
        if len(twice := np.flatnonzero(same & (np.diff(times[order]) == 0.0))):
            first, second = sorted(order[twice[0] : twice[0] + 2].tolist())
            self._fail_of_twice(first, second, f"at {times[second]:g} s")
        parts = np.split(order, np.flatnonzero(~same) + 1)
        channels = tuple(
            _Channel(self.names[self.muscles[k[0]]], times[k], self.values[k], self.sd[k])
            for k in parts
        )
        return KnownCourse(channels, 1.0 / rate, self.options)

    def _at(self, rows: list[int]) -> KnownMuscles:
        names = tuple(self.names[self.muscles[row]] for row in rows)
        return KnownMuscles(names, self.values[rows], self.sd[rows])

    def _fail(self, row: int, code: str, message: str, **more: object) -> NoReturn:
        """Raise the error of a row."""
        line = int(self.lines[row])
        muscle = self.names[self.muscles[row]]
        where = {"line": line, "muscle": muscle, **more}
        raise file_error(code, self.file, f"{muscle}: {message}", **where)

    def _fail_of_columns(self, message: str) -> NoReturn:
        raise file_error("activations.columns", self.file, message, line=1)

    def _fail_of_expression(self, row: int, capture: str, captures: Sequence[str]) -> NoReturn:
        known = ", ".join(quote_names(captures))
        message = f"the fit has no expression {quote(capture)}: it has {known}"
        if not capture:
            message = f"names no expression, and the fit has several: {known}"
        found = quote(capture)
        expected = quote_names(captures)
        self._fail(row, "activations.expression", message, found=found, expected=expected)

    def _fail_of_twice(self, first: int, second: int, where: str) -> NoReturn:
        before = int(self.lines[first])
        message = f"is given twice {where}: line {before} has it, too"
        self._fail(second, "activations.duplicate", message, before=before)


def read_known(
    path: Path, muscles: Sequence[str], options: KnownTableOptions = KnownTableOptions()
) -> KnownTable:
    """Read a table of what is known of ``muscles``, those that a fit moves.

    Raises :class:`InputError` with file, line and muscle: ``activations.unreadable`` for what is
    no table or too large a one, ``activations.columns``, ``activations.muscle`` for one that is not
    known or whose side is not clear, ``activations.value``, ``activations.sd`` and
    ``activations.time`` for numbers that cannot be.
    """
    size = path.stat().st_size
    if size > options.most_bytes:
        message = f"has {size:,} bytes, {options.most_bytes:,} at most are read"
        raise file_error("activations.unreadable", path.name, message)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        message = f"is no text in UTF-8 (byte {error.start})"
        raise file_error("activations.unreadable", path.name, message) from error
    return _TableReader(path.name, muscles, options).read(text)


class _TableReader:
    """Reads one table row by row; errors name the line."""

    def __init__(self, file: str, muscles: Sequence[str], options: KnownTableOptions) -> None:
        self._file = file
        self._options = options
        self._find = MuscleFinder(muscles)
        self._line = 1

    def read(self, text: str) -> KnownTable:
        rows = self._rows(text)
        columns = self._columns(next(rows, []))
        numbers = {each: array("d") for each in NUMBERS}
        muscles = array("q")
        lines = array("q")
        expressions = list[str]()
        known: dict[str, int] = {}  # muscle -> its number
        spelt: dict[tuple[str, str], int] = {}  # a spelling that was found before -> the same
        for fields in rows:
            row = dict(zip(columns, fields, strict=True))
            key = row["muscle"], row.get("side", "")
            if key not in spelt:
                spelt[key] = known.setdefault(self._muscle(*key), len(known))
            for name in numbers.keys() & row.keys():
                numbers[name].append(self._number(row, name))
            muscles.append(spelt[key])
            lines.append(self._line)
            expressions.append(row.get("expression", ""))
        if not lines:
            self._fail("activations.unreadable", "has no rows under its heading")
        return KnownTable(
            self._file,
            tuple(known),
            np.array(muscles),
            np.array(numbers["value"]),
            np.array(numbers["sd"]),
            np.array(lines),
            times=np.array(numbers["time"]) if "time" in columns else None,
            expressions=tuple(expressions) if "expression" in columns else None,
            options=self._options,
        )

    def _rows(self, text: str) -> Iterator[list[str]]:
        """Give the fields of every row that is not blank."""
        reader = csv.reader(self._lines(text))
        width = 0
        try:
            for fields in reader:
                self._line = reader.line_num
                if self._line > self._options.most_rows + 1:
                    message = f"has more than {self._options.most_rows:,} rows"
                    self._fail("activations.unreadable", message)
                found = [each.strip() for each in fields]
                if not any(found):
                    continue
                if any(len(each) > self._options.longest_field for each in found):
                    message = f"a field has more than {self._options.longest_field} characters"
                    self._fail("activations.unreadable", message)
                width = width or len(found)
                if len(found) != width:
                    self._fail(
                        "activations.unreadable", f"{width} columns expected, {len(found)} found"
                    )
                yield found
        except csv.Error as error:
            self._line = reader.line_num
            self._fail("activations.unreadable", f"is no table: {error}")

    def _lines(self, text: str) -> Iterator[str]:
        """Give the lines of a text, none of them of more columns than can be kept."""
        for number, line in enumerate(io.StringIO(text, newline=""), start=1):
            if len(line) > self._options.longest_line:
                self._line = number
                message = f"the line has more than {self._options.longest_line:,} characters"
                self._fail("activations.unreadable", message)
            yield line

    def _columns(self, heading: list[str]) -> list[str]:
        columns = [each.lower() for each in heading]
        told = f"it has the columns {', '.join(NEEDED)}, and may have side and time or expression"
        if unknown := [each for each in columns if each not in COLUMNS]:
            self._fail(
                "activations.columns", f"the column {quote(unknown[0])} is not known: {told}"
            )
        if len({*columns}) < len(columns):
            self._fail("activations.columns", f"a column stands twice: {told}")
        if missing := [each for each in NEEDED if each not in columns]:
            self._fail("activations.columns", f"the column {missing[0]} is missing: {told}")
        if {*PLACES} <= {*columns}:
            self._fail(
                "activations.columns", "time and expression exclude each other: a take has times"
            )
        return columns

    def _muscle(self, muscle: str, side: str) -> str:
        try:
            return self._find(muscle, side)
        except LookupError as error:
            self._fail("activations.muscle", str(error), muscle=quote(muscle))

    def _number(self, row: Mapping[str, str], name: str) -> float:
        """Return a number of a row that can be what its column ``name`` says."""
        given = row[name]
        options = self._options
        code = NUMBERS[name]
        try:
            found = float(given)
        except ValueError:
            found = np.nan
        if not np.isfinite(found):
            self._fail_of(row, code, f"the {name} {quote(given)} is no number")
        if name == "value" and not options.least <= found <= options.most:
            words = f"the value {quote(given)} is not a part of the fibres' length, from "
            self._fail_of(row, code, f"{words}{options.least:g} to {options.most:g}")
        if name == "sd" and found <= 0.0:
            self._fail_of(row, code, f"the sd {quote(given)} is not above 0")
        return found

    def _fail_of(self, row: Mapping[str, str], code: str, message: str) -> NoReturn:
        muscle = quote(row["muscle"])
        message = f"{muscle}: {message}"
        raise file_error(code, self._file, message, line=self._line, muscle=muscle)

    def _fail(self, code: str, message: str, **more: str) -> NoReturn:
        raise file_error(code, self._file, message, line=self._line, **more)


class MuscleFinder:
    """Finds muscles and wholes by their names, the side being in the name or beside it."""

    def __init__(self, muscles: Sequence[str]) -> None:
        self._muscles = muscles
        self._known: dict[str, dict[str, str]] = {}  # name without side -> side -> name
        for name in muscles:
            parts = name.split(".")
            for count in range(len(parts), 0, -1):
                whole = ".".join(parts[:count])
                sides = self._known.setdefault(both_sides(whole).lower(), {})
                sides.setdefault(muscle_side(whole), whole)

    def __call__(self, muscle: str, side: str = "") -> str:
        """Return the name of a muscle or a whole; raises ``LookupError`` with what is wrong."""
        if side.lower() not in SIDES:
            raise LookupError(f"the side {quote(side)} is neither left nor right nor empty")
        own = muscle_side(muscle)
        beside = SIDES[side.lower()]
        if own and beside and own != beside:
            raise LookupError(f"{quote(muscle)} is on the {own}, its side is given as {beside}")
        asked = own or beside
        sides = self._known.get(both_sides(muscle).lower(), {}) if muscle else {}
        if asked in sides:
            return sides[asked]
        if not sides:
            told = tell_muscles(muscle, self._muscles)
            raise LookupError(f"no muscle is called {quote(muscle)}: {told}")
        if not asked:
            raise LookupError(f"{quote(muscle)} has two sides: say left or right")
        raise LookupError(f"{quote(muscle)} is in the middle of the face: it has no side")
