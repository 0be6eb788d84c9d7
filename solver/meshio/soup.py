"""Formats that join nothing: loose triangles (STL), and points as text (XYZ, PTS, ASC, CSV)."""

from __future__ import annotations

import re

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
    weld,
)
from solver.surface import Floats

HEADER_BYTES = 84  # 80 of text, then the number of triangles as uint32
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return the mesh of STL ``content``; ``file`` names it in errors.

    For registered scans (``strict``) every triangle keeps its own three vertices, in the order of
    the file; otherwise corners in one place become one vertex.
    """
    # some binary files start with the word 'solid' too
    is_text = content[:5].lower() == b"solid" and b"\0" not in content[:1024]
    corners = _read_ascii(file, content) if is_text else _read_binary(file, content)
    if not len(corners):
        raise empty_error(file)
    vertices = corners.reshape(-1, 3)
    if strict:
        return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    first, numbers = weld(vertices)
    return Mesh(vertices[first], numbers.reshape(-1, 3))


def _read_binary(file: str, content: bytes) -> Floats:
    """Return the corners (f, 3, 3) of the triangles."""
    found = len(content)
    if found < HEADER_BYTES:
        raise truncated_error(file, f"{found} bytes are not even the header of an STL file")
    count = int.from_bytes(content[HEADER_BYTES - 4 : HEADER_BYTES], "little")
    expected = HEADER_BYTES + count * FACET.itemsize
    if found < expected:
        reason = f"{count} triangles take {expected} bytes, found {found}"
        raise truncated_error(file, reason, expected=expected, found=found)
    facets = np.frombuffer(content, FACET, count=count, offset=HEADER_BYTES)
    return facets["corners"].astype(np.float64)


def _read_ascii(file: str, content: bytes) -> Floats:
    """Return the corners (f, 3, 3) of the triangles, or name the line that is at fault."""
    lines = content.splitlines()
    rows = [line.lstrip()[6:] for line in lines if _is_vertex(line)]
    parsed = parse_rows(rows, (3,))
    if rows and parsed is None:
        bad = find_bad_row(rows, (3,))
        if bad is None:
            raise unreadable_error(file, "not a valid STL file")
        row, _, are_numbers = bad
        reason = "a vertex needs 3 numbers" if are_numbers else "not three numbers"
        numbers = [number for number, line in enumerate(lines, start=1) if _is_vertex(line)]
        raise unreadable_error(file, reason, line=numbers[row])
    last = next((line for line in reversed(lines) if line.strip()), b"")
    if last.split()[:1] != [b"endsolid"] or len(rows) % 3:
        raise truncated_error(file, "the last line is not 'endsolid'")
    return np.zeros((0, 3, 3)) if parsed is None else parsed[0].reshape(-1, 3, 3)


def _is_vertex(line: bytes) -> bool:
    return line.lstrip().startswith(b"vertex")


MAX_COLUMNS = 12  # position, intensity, normal and colour, with room for one column more or two
HEAD_BYTES = 4096  # at the beginning of a file, in which ...
HEAD_LINES = 8  # ... these lines show how its numbers are written
# three numbers or more, each with one comma, apart by semicolons, tabs or blanks
DECIMAL_COMMAS = re.compile(rb"\s*[-+]?\d+,\d+(?:[; \t]+[-+]?\d+,\d+){2,}[; \t]*")
UNIT_LENGTH = 0.02  # the median length of normals differs from 1 by less


def read_xyz(file: str, content: bytes) -> Mesh:
    """Return the point cloud of ``content``: columns x y z, then normals and colours as found.

    Columns are separated by blanks, commas or semicolons. Lines that begin with ``#`` or ``//``,
    one heading and the line with the number of points (PTS) are skipped. Three columns that are
    unit vectors are normals; three that are whole numbers up to 255 or lie in [0, 1] are colours.
    """
    _refuse_commas(file, content)
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


def _refuse_commas(file: str, content: bytes) -> None:
    """Raise ``scan.unreadable`` for decimal commas, which would be read as ends of numbers."""
    head = content[:HEAD_BYTES].splitlines()[:HEAD_LINES]
    for number, line in enumerate(head, start=1):
        if DECIMAL_COMMAS.fullmatch(line):
            reason = "its numbers have decimal commas: write them with points"
            raise unreadable_error(file, reason, line=number)


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
