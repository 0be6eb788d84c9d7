"""Reading CSV as Motive exports it: a heading of names and values, then a frame a row.

Above the row ``Frame, Time`` others describe each column: its type (``Marker``,
``Rigid Body``, ``Rigid Body Marker``), its name, whether it is a position or a rotation. A marker
that was seen has the type ``Marker``; those of other types are where a solver thinks that they are,
and are read only where none of the name was seen.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from solver.scans.markers.raw_take import RawTake, TakeOptions, unreadable_error
from solver.scans.markers.table import Heading, Line, finish_table, read_lines, read_table

MOST_HEADING = 20  # lines
SEEN = "marker"  # the type of a marker's columns


@dataclass(frozen=True)
class _Track:
    """Three columns of one name, which begin at ``column``."""

    name: str
    kind: str
    column: int


def read_motive(path: Path, options: TakeOptions) -> RawTake:
    """Return the markers of a CSV of Motive.

    Raises :class:`InputError`: ``markers.unreadable`` with ``line``, ``markers.truncated`` (also
    with fewer frames than the heading has), ``markers.none`` or ``markers.too_large``.
    """
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


def _fields(file: str, line: Line) -> list[str]:
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


def _tracks(file: str, rows: list[list[str]]) -> list[_Track]:
    """Return all tracks of positions that the heading names."""
    axes = [field.lower() for field in rows[-1]]
    above = [row for row in rows[1:-1] if any(row)]
    if len(above) < 3:
        reason = "rows of types, names and kinds are expected above 'Frame, Time'"
        raise unreadable_error(file, reason, line=len(rows))
    kinds, names, places = above[0], above[1], above[-1]
    tracks, column = [], 2
    while column < len(axes):
        if _at(places, column).lower() != "position":
            column += 1
            continue
        of_one = all(len({_at(row, column + axis) for axis in range(3)}) == 1 for row in above)
        if not of_one or axes[column : column + 3] != ["x", "y", "z"]:
            reason = f"columns {column + 1} to {column + 3} are not x, y, z of one marker"
            raise unreadable_error(file, reason, line=len(rows))
        tracks.append(_Track(_at(names, column), _at(kinds, column).lower(), column))
        column += 3
    return tracks


def _choose_tracks(tracks: list[_Track]) -> list[_Track]:
    """Return tracks of markers: as they were seen, or else as a solver has them."""
    seen = [track for track in tracks if track.kind == SEEN]
    names = {track.name for track in seen}
    solved = [track for track in tracks if SEEN in track.kind and track.name not in names]
    return seen + [track for track in solved if track.kind != SEEN]


def _at(row: Sequence[str], column: int) -> str:
    return row[column] if column < len(row) else ""
