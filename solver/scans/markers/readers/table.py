"""Reading tables of text, a frame a row: TRC of Cortex and OpenSim, and CSV as Motive exports it.

A TRC has a heading of five lines. In Motive's CSV, rows above ``Frame, Time`` describe each
column: its type (``Marker``, ``Rigid Body``, ``Rigid Body Marker``), its name, whether it is a
position or a rotation. A marker that was seen has the type ``Marker``; those of other types are
where a solver thinks that they are, and are read only where none of the name was seen. Numbers are
blank where a point is missing.
"""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import IO

import numpy as np

from solver.errors import Finding, quote
from solver.scans.markers.readers.raw_take import (
    MOST_FRAME,
    RawTake,
    TakeOptions,
    check_room,
    choose_rate,
    decode,
    make_finding,
    spread_frames,
    truncated_error,
    unreadable_error,
)
from solver.surface import Floats

DROPPED = (2, 4)  # numbers that a timecode leaves out at once
SAME_STEP = 0.1  # of the time between frames: it passed as between any two


@dataclass(frozen=True)
class TableLine:
    """A line of a file, without its end."""

    number: int
    text: str
    is_whole: bool  # it has an end


@dataclass(frozen=True)
class Table:
    """Frames as rows have them: their numbers and times in s (NaN if blank), points (f, n, 3)."""

    numbers: list[int]
    times: list[float]
    points: Floats
    findings: tuple[Finding, ...] = ()

    def timed_rate(self) -> list[tuple[str, float]]:
        """Return the rate in Hz by the times, as :func:`choose_rate` takes it."""
        if len(self.numbers) < 2:
            return []
        # the usual step: a clock may jump, or be set anew
        step = float(np.median(np.diff(self.times) / np.diff(self.numbers)))
        return [("its times", 1.0 / step)] if step > 0 else []


def read_lines(file: str, stream: IO[bytes], options: TakeOptions) -> Iterator[TableLine]:
    """Give lines one after the other; none that is too long is ever whole in memory."""
    number = 0
    while line := stream.readline(options.longest_line + 1):
        number += 1
        if len(line) > options.longest_line:
            raise unreadable_error(
                file, f"it has more than {options.longest_line} bytes", line=number
            )
        text = decode(line.removeprefix(b"\xef\xbb\xbf").rstrip(b"\r\n"))
        yield TableLine(number, text, line.endswith((b"\n", b"\r")))


def split_row(text: str, separator: str | None) -> list[str]:
    """Return a row's fields without blanks around them; None separates by any blanks."""
    return [field.strip() for field in text.split(separator)]


def read_table(
    file: str,
    lines: Iterator[TableLine],
    separator: str | None,
    columns: Sequence[int],
    width: int,
    options: TakeOptions,
) -> Table:
    """Return the frames of all further lines of ``width`` columns: number, time, and points.

    x, y, z of n points are at ``columns`` (3 n). Numbers of frames increase; those that are left
    out are missing from the table.
    """
    check_room(file, 1, len(columns) // 3, options)
    pick = itemgetter(*columns)
    numbers: list[int] = []
    times: list[float] = []
    values = array("d")
    for line in lines:
        if not line.text.strip():
            continue
        fields = split_row(line.text, separator)
        if len(fields) < width:
            reason = f"{width} columns expected, {len(fields)} found"
            if not line.is_whole:
                raise truncated_error(
                    file, f"line {line.number}, the last: {reason}", line=line.number
                )
            raise unreadable_error(file, reason, line=line.number)
        if any(fields[width:]):
            reason = f"{width} columns expected, {len(fields)} found"
            raise unreadable_error(file, reason, line=line.number)
        numbers.append(_frame(file, line.number, fields[0], numbers))
        times.append(*_numbers(file, line.number, fields[1:2]))
        values.extend(_numbers(file, line.number, pick(fields)))
        check_room(file, len(numbers), len(columns) // 3, options)
    check_room(file, len(numbers), len(columns) // 3, options)
    points = np.frombuffer(values).reshape(len(numbers), -1, 3)
    points[~points.any(axis=-1)] = np.nan  # exactly 0, 0, 0
    return _count_on(file, Table(numbers, times, points))


@dataclass(frozen=True)
class Heading:
    """Texts of a heading about the table under it; None for those that it leaves out."""

    frames: str | None
    rate: str | None
    unit: str | None
    markers: str | None = None


def finish_table(
    file: str, names: Sequence[str], table: Table, heading: Heading, options: TakeOptions
) -> RawTake:
    """Return a table as a take, each frame in its place, after a look at its heading.

    Raises :class:`InputError` ``markers.truncated`` if that promises more frames.
    """
    found = table.numbers[-1] - table.numbers[0] + 1
    expected = _count(heading.frames)
    if expected is not None and found < expected:
        reason = f"its heading says {expected} frames, found {found}"
        raise truncated_error(file, reason, expected=expected, found=found)
    markers = table.points.shape[1]
    findings = _compare(file, "markers", _count(heading.markers), markers)
    findings += _compare(file, "frames", expected, found)
    points, gaps = spread_frames(file, table.numbers, table.points, options)
    rate, rates = choose_rate(file, [*_rate(heading.rate), *table.timed_rate()], options)
    every = [*findings, *table.findings, *gaps, *rates]
    return RawTake(names, points, rate, table.numbers[0], heading.unit, findings=every)


def _compare(file: str, what: str, expected: int | None, found: int) -> list[Finding]:
    if expected in (None, found):
        return []
    message = f"{file} says {expected} {what} and has {found}, which are read."
    return [make_finding("markers.header", "warning", message, file=file, found=found)]


def _count_on(file: str, table: Table) -> Table:
    """Return a table whose frames are counted without what a drop-frame timecode leaves out.

    It leaves out the first two numbers (four beyond 30 Hz) of most minutes, and no time passes.
    """
    steps = np.diff(np.array(table.times))
    numbers = np.array(table.numbers)
    left_out = np.diff(numbers) - 1
    dropped = np.isin(left_out, DROPPED)
    if not dropped.any() or not np.isfinite(steps).all():
        return table
    usual = float(np.median(steps))
    dropped &= np.abs(steps - usual) < SAME_STEP * usual
    count = int(dropped.sum())
    if not count:
        return table
    numbers[1:] -= np.cumsum(np.where(dropped, left_out, 0))
    places = f"{count} places" if count > 1 else "one place"
    message = f"{file} counts frames by drop-frame timecode, which leaves out numbers at {places}."
    found = make_finding("markers.frames", "info", message, file=file, places=count)
    return replace(table, numbers=numbers.tolist(), findings=(found,))


def _count(text: str | None) -> int | None:
    """Return a whole number of a heading, None for anything else."""
    is_number = text is not None and text.isascii() and text.isdigit() and len(text) < 10
    return int(text) if is_number and text else None


def _rate(text: str | None) -> list[tuple[str, float]]:
    """Return the rate of a heading, as :func:`choose_rate` takes it."""
    try:
        return [] if not text else [("its heading", float(text))]
    except ValueError:
        return []


def _frame(file: str, line: int, text: str, before: Sequence[int]) -> int:
    """Return a frame's number, which is above those before."""
    if not (text.isascii() and text.removeprefix("-").isdigit() and len(text) < 12):
        raise unreadable_error(file, f"'{quote(text)}' is not the number of a frame", line=line)
    number = int(text)
    if abs(number) > MOST_FRAME:
        raise unreadable_error(file, f"'{quote(text)}' is not the number of a frame", line=line)
    if before and number <= before[-1]:
        raise unreadable_error(file, f"frame {number} follows frame {before[-1]}", line=line)
    return number


def _numbers(file: str, line: int, fields: Sequence[str]) -> list[float]:
    """Return numbers, NaN for blanks."""
    try:
        return [float(field) if field else np.nan for field in fields]
    except ValueError:
        bad = next(field for field in fields if field and not _is_number(field))
        raise unreadable_error(file, f"'{quote(bad)}' is not a number", line=line) from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


HEADING = 5  # lines: type, names of values, values, labels, coordinates


def read_trc(path: Path, options: TakeOptions) -> RawTake:
    """Return the points of a TRC file.

    Raises :class:`InputError`: ``markers.unreadable`` with ``line``, ``markers.truncated`` (also
    with fewer frames than the heading has), ``markers.none`` or ``markers.too_large``.
    """
    file = path.name
    with path.open("rb") as stream:
        lines = read_lines(file, stream, options)
        heading = list(islice(lines, HEADING))
        if len(heading) < HEADING:
            raise truncated_error(file, f"its heading has {HEADING} lines, found {len(heading)}")
        separator = "\t" if "\t" in heading[3].text else None
        fields = dict(
            zip(
                (name.lower() for name in split_row(heading[1].text, separator)),
                split_row(heading[2].text, separator),
                strict=False,
            )
        )
        count = _coordinates(file, heading[4], separator)
        names = _label_names(file, heading[3], separator, count)
        columns = range(2, 2 + 3 * count)
        table = read_table(file, lines, separator, columns, 2 + 3 * count, options)
    about = Heading(*map(fields.get, ("numframes", "datarate", "units", "nummarkers")))
    return finish_table(file, names, table, about, options)


def _coordinates(file: str, line: TableLine, separator: str | None) -> int:
    """Return the number of points by the line with X1, Y1, Z1, X2 and so on."""
    axes = [field[:1].lower() for field in split_row(line.text, separator) if field]
    count = len(axes) // 3
    if not axes or axes != ["x", "y", "z"] * count:
        reason = "X1, Y1, Z1, X2 and so on are expected here"
        raise unreadable_error(file, reason, line=line.number)
    return count


def _label_names(file: str, line: TableLine, separator: str | None, count: int) -> Sequence[str]:
    """Return labels, each over its x; where tabs are too few, one after the other."""
    fields = split_row(line.text, separator)
    if not fields[0].lower().startswith("frame"):
        raise unreadable_error(
            file, "'Frame#', 'Time' and labels are expected here", line=line.number
        )
    over_x = fields[2 : 2 + 3 * count : 3]
    others = chain(fields[3::3], fields[4::3])
    if not any(others) and not any(fields[2 + 3 * count :]):
        return over_x
    labels = [field for field in fields[2:] if field]
    if len(labels) != count:
        reason = f"{len(labels)} labels over the coordinates of {count} points"
        raise unreadable_error(file, reason, line=line.number)
    return labels


MOST_HEADING = 20  # lines
SEEN = "marker"  # the type of a marker's columns


@dataclass(frozen=True)
class _PointColumns:
    """Three columns of one name, which begin at ``column``."""

    name: str
    kind: str
    column: int


def read_motive(path: Path, options: TakeOptions) -> RawTake:
    """Return the markers of a CSV of Motive; raises as :func:`read_trc`."""
    file = path.name
    with path.open("rb") as stream:
        lines = read_lines(file, stream, options)
        rows: list[list[str]] = []
        for line in lines:
            rows.append(_fields(file, line))
            if _is_last(rows[-1]) or len(rows) == MOST_HEADING:
                break
        if not rows or not _is_last(rows[-1]):
            reason = "no row 'Frame, Time' in its first lines: export markers with their headings"
            raise unreadable_error(file, reason)
        fields = {
            name.lower(): value for name, value in zip(rows[0][::2], rows[0][1::2], strict=False)
        }
        tracks = _choose_tracks(_tracks(file, rows))
        columns = [track.column + axis for track in tracks for axis in range(3)]
        table = read_table(file, lines, ",", columns, max(map(_width, rows[1:])), options)
    rate = fields.get("export frame rate") or fields.get("capture frame rate")
    about = Heading(fields.get("total exported frames"), rate, fields.get("length units"))
    return finish_table(file, [track.name for track in tracks], table, about, options)


def _fields(file: str, line: TableLine) -> list[str]:
    try:
        return [field.strip() for field in next(csv.reader([line.text]), [])]
    except csv.Error as error:
        raise unreadable_error(
            file, f"it is not a row of CSV: {error}", line=line.number
        ) from error


def _is_last(row: Sequence[str]) -> bool:
    """Tell whether a row is the heading's last."""
    return len(row) > 1 and row[0].lower() == "frame" and row[1].lower().startswith("time")


def _width(row: Sequence[str]) -> int:
    """Return how many columns a row has without the blank ones at its end."""
    return max((column + 1 for column, field in enumerate(row) if field), default=0)


def _tracks(file: str, rows: list[list[str]]) -> list[_PointColumns]:
    """Return all tracks of positions that the heading names."""
    axes = [field.lower() for field in rows[-1]]
    above = [row for row in rows[1:-1] if any(row)]
    if len(above) < 3:
        reason = "rows of types, names and kinds are expected above 'Frame, Time'"
        raise unreadable_error(file, reason, line=len(rows))
    kinds = above[0]
    names = above[1]
    places = above[-1]
    tracks = []
    column = 2
    while column < len(axes):
        if _at(places, column).lower() != "position":
            column += 1
            continue
        of_one = all(len({_at(row, column + axis) for axis in range(3)}) == 1 for row in above)
        if not of_one or axes[column : column + 3] != ["x", "y", "z"]:
            reason = f"columns {column + 1} to {column + 3} are not x, y, z of one marker"
            raise unreadable_error(file, reason, line=len(rows))
        tracks.append(_PointColumns(_at(names, column), _at(kinds, column).lower(), column))
        column += 3
    return tracks


def _choose_tracks(tracks: list[_PointColumns]) -> list[_PointColumns]:
    """Return tracks of markers: as they were seen, or else as a solver has them."""
    seen = [track for track in tracks if track.kind == SEEN]
    names = {track.name for track in seen}
    solved = [track for track in tracks if SEEN in track.kind and track.name not in names]
    return seen + [track for track in solved if track.kind != SEEN]


def _at(row: Sequence[str], column: int) -> str:
    return row[column] if column < len(row) else ""
