"""Point clouds as text (XYZ, PTS, ASC, CSV): a point a line, with normals or colours or neither."""

from __future__ import annotations

import numpy as np

from solver.errors import InputError
from solver.meshio.faults import empty_error, truncated_error, unreadable_error
from solver.meshio.mesh import Mesh, columns, numbers_by_row, parse_numbers, unit_colours
from solver.surface import Floats

MAX_COLUMNS = 12  # position, intensity, normal and colour, with room for one column more or two
UNIT_LENGTH = 0.02  # the median length of normals differs from 1 by less


def read_xyz(file: str, content: bytes) -> Mesh:
    """Return the point cloud of ``content``: columns x y z, then normals and colours as found.

    Columns are separated by blanks, commas or semicolons. Lines that begin with ``#`` or ``//``,
    one heading and the line with the number of points (PTS) are skipped. Three columns that are
    unit vectors are normals; three that are whole numbers up to 255 or lie in [0, 1] are colours.
    """
    lines = content.translate(bytes.maketrans(b",;\t\r", b"    ")).split(b"\n")
    first = _first_row(lines)
    rows = [line for line in lines[first:] if line.strip() and not _is_comment(line)]
    if not rows:
        raise empty_error(file)
    parsed = numbers_by_row(b"\n".join(rows))
    width = len(rows[0].split())
    if parsed is None or width < 3 or (parsed[1] != width).any():
        raise _find_fault(file, content, lines, first, width)
    if width > MAX_COLUMNS:
        raise unreadable_error(file, f"{width} columns: a point has x, y, z, normal and colour")
    values, counts = parsed
    announced = _point_count(lines[:first])
    if announced is not None and announced > len(rows):
        raise truncated_error(
            file,
            f"{announced} points announced, {len(rows)} follow",
            expected=announced,
            found=len(rows),
        )
    normals, colours = _attributes(columns(values, counts, 3, width))
    return Mesh(columns(values, counts, 0, 3), normals=normals, colours=colours)


def _is_comment(line: bytes) -> bool:
    return line.lstrip().startswith((b"#", b"//"))


def _first_row(lines: list[bytes]) -> int:
    """Return the line (from 0) of the first point, behind comments, heading and point count."""
    headings = 0
    for number, line in enumerate(lines):
        if not line.strip() or _is_comment(line):
            continue
        values = parse_numbers(line)
        if values is not None and len(values) >= 3:
            return number
        headings += 1
        if headings > 2:
            return number
    return len(lines)


def _point_count(heading: list[bytes]) -> int | None:
    counts = [line.strip() for line in heading if line.strip().isdigit()]
    return int(counts[0]) if counts else None


def _attributes(rest: Floats) -> tuple[Floats | None, Floats | None]:
    """Return normals and colours among the columns behind x, y, z."""
    normals = colours = None
    start = 0
    if rest.shape[1] in (1, 4, 7):  # PTS: the intensity comes first
        start = 1
    for column in range(start, rest.shape[1] - 2, 3):
        part = rest[:, column : column + 3]
        lengths = np.linalg.norm(part, axis=1)
        if normals is None and part.min() < 0 and np.abs(np.median(lengths) - 1) < UNIT_LENGTH:
            normals = part
        elif colours is None and part.min() >= 0 and part.max() <= 255:
            colours = unit_colours(part)
    return normals, colours


def _find_fault(
    file: str, content: bytes, lines: list[bytes], first: int, width: int
) -> InputError:
    """Return the fault of the first line that is not ``width`` numbers."""
    for number, line in enumerate(lines[first:], start=first + 1):
        if not line.strip() or _is_comment(line):
            continue
        values = parse_numbers(line)
        if values is not None and len(values) == width >= 3:
            continue
        if number == len(lines) and not content.endswith(b"\n"):
            return truncated_error(file, f"line {number}, the last, is not whole", line=number)
        if values is None:
            return unreadable_error(file, "not a row of numbers", line=number)
        expected = max(width, 3)
        reason = f"{expected} numbers expected, {len(values)} found"
        return unreadable_error(file, reason, line=number)
    return unreadable_error(file, "not a list of points")
