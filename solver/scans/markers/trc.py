"""Reading TRC, the tables of Cortex and OpenSim: a heading of five lines, then a frame a row."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path

from solver.scans.markers.raw_take import RawTake, TakeOptions, truncated_error, unreadable_error
from solver.scans.markers.table import (
    Heading,
    Line,
    finish_table,
    read_lines,
    read_table,
    split_row,
)

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
        names = _names(file, heading[3], separator, count)
        columns = range(2, 2 + 3 * count)
        table = read_table(file, lines, separator, columns, 2 + 3 * count, options)
    about = Heading(*map(fields.get, ("numframes", "datarate", "units", "nummarkers")))
    return finish_table(file, names, table, about, options)


def _coordinates(file: str, line: Line, separator: str | None) -> int:
    """Return the number of points by the line with X1, Y1, Z1, X2 and so on."""
    axes = [field[:1].lower() for field in split_row(line.text, separator) if field]
    count = len(axes) // 3
    if not axes or axes != ["x", "y", "z"] * count:
        reason = "X1, Y1, Z1, X2 and so on are expected here"
        raise unreadable_error(file, reason, line=line.number)
    return count


def _names(file: str, line: Line, separator: str | None, count: int) -> Sequence[str]:
    """Return labels, each over its x; where tabs are too few, one after the other."""
    fields = split_row(line.text, separator)
    if not fields[0].lower().startswith("frame"):
        raise unreadable_error(
            file, "'Frame#', 'Time' and labels are expected here", line=line.number
        )
    over_x, others = fields[2 : 2 + 3 * count : 3], chain(fields[3::3], fields[4::3])
    if not any(others) and not any(fields[2 + 3 * count :]):
        return over_x
    labels = [field for field in fields[2:] if field]
    if len(labels) != count:
        reason = f"{len(labels)} labels over the coordinates of {count} points"
        raise unreadable_error(file, reason, line=line.number)
    return labels
