"""STL, binary and ascii: loose triangles, which share no vertices."""

from __future__ import annotations

import numpy as np

from solver.meshio.mesh import (
    Mesh,
    empty_error,
    find_bad_row,
    parse_rows,
    truncated_error,
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
