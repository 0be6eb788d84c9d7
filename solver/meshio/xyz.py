"""Point clouds as text (XYZ, PTS, ASC, CSV): a point a line, with normals or colours or neither."""

from __future__ import annotations

import numpy as np

from solver.errors import InputError
from solver.meshio.mesh import (
    Mesh,
    columns,
    empty_error,
    find_bad_row,
    parse_count,
    parse_numbers,
    parse_rows,
    truncated_error,
    unit_colours,
    unreadable_error,
)
from solver.surface import Floats

MAX_COLUMNS = 12  # position, intensity, normal and colour, with room for one column more or two
UNIT_LENGTH = 0.02  # the median length of normals differs from 1 by less


def read_xyz(file: str, content: bytes) -> Mesh:
    """Return the point cloud of ``content``: columns x y z, then normals and colours as found.

    Columns are separated by blanks, commas or semicolons. Lines that begin with ``#`` or ``//``,
    one heading and the line with the number of points (PTS) are skipped. Three columns that are
    unit vectors are normals; three that are whole numbers up to 255 or lie in [0, 1] are colours.
    """
    every = content.translate(bytes.maketrans(b",;\t\r", b"    ")).split(b"\n")
    lines = [line for line in every if _has_values(line)]
    first = _first_row(lines[:3])
    rows = lines[first:]
    if not rows:
        raise empty_error(file)
    width = len(rows[0].split())
    parsed = parse_rows(rows, (width,)) if width >= 3 else None
    if parsed is None:
        numbers = [number for number, line in enumerate(every, start=1) if _has_values(line)]
        is_cut = numbers[-1] == len(every) and not content.endswith(b"\n")
        raise _find_fault(file, numbers[first:], rows, max(width, 3), is_cut=is_cut)
    if width > MAX_COLUMNS:
        raise unreadable_error(file, f"{width} columns: a point has x, y, z, normal and colour")
    values, counts = parsed
    announced = [parse_count(line.strip()) for line in lines[:first]]
    expected = next((count for count in announced if count is not None), 0)
    if expected > len(rows):
        reason = f"{expected} points announced, {len(rows)} follow"
        raise truncated_error(file, reason, expected=expected, found=len(rows))
    normals, colours = _attributes(columns(values, counts, 3, width))
    return Mesh(columns(values, counts, 0, 3), normals=normals, colours=colours)


def _has_values(line: bytes) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith((b"#", b"//"))


def _first_row(lines: list[bytes]) -> int:
    """Return how many of the first ``lines`` come before a point: a heading, a count, at most 2."""
    for number, line in enumerate(lines):
        values = parse_numbers(line)
        if number == 2 or (values is not None and len(values) >= 3):
            return number
    return len(lines)


def _attributes(rest: Floats) -> tuple[Floats | None, Floats | None]:
    """Return normals and colours among the columns behind x, y, z."""
    normals = colours = None
    start = 1 if rest.shape[1] in (1, 4, 7) else 0  # PTS: the intensity comes first
    for column in range(start, rest.shape[1] - 2, 3):
        part = rest[:, column : column + 3]
        lengths = np.linalg.norm(part, axis=1)
        if normals is None and part.min() < 0 and np.abs(np.median(lengths) - 1) < UNIT_LENGTH:
            normals = part
        elif colours is None and part.min() >= 0 and part.max() <= 255:
            colours = unit_colours(part)
    return normals, colours


def _find_fault(
    file: str, numbers: list[int], rows: list[bytes], width: int, *, is_cut: bool
) -> InputError:
    """Return the fault of the first row that is not ``width`` numbers; ``numbers`` are its lines.

    With ``is_cut`` the file ends within the last row.
    """
    bad = find_bad_row(rows, (width,))
    if bad is None:
        return unreadable_error(file, "not a list of points")
    row, found, are_numbers = bad
    line = numbers[row]
    if is_cut and row == len(rows) - 1:
        return truncated_error(file, f"line {line}, the last, is not whole", line=line)
    reason = f"{width} numbers expected, {found} found" if are_numbers else "not a row of numbers"
    return unreadable_error(file, reason, line=line)
