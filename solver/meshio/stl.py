"""STL, binary and ascii: loose triangles, which share no vertices."""

from __future__ import annotations

import numpy as np

from solver.meshio.faults import empty_error, truncated_error, unreadable_error
from solver.meshio.mesh import Mesh, numbers_by_row, parse_numbers, weld
from solver.surface import Floats

HEADER_BYTES = 84  # 80 of text, then the number of triangles as uint32
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return the mesh of STL ``content``; ``file`` names it in errors.

    For registered scans (``strict``) every triangle keeps its own three vertices, in the order of
    the file; otherwise corners in one place become one vertex.
    """
    corners = _read_binary(file, content) if _is_binary(content) else _read_ascii(file, content)
    if len(corners) == 0:
        raise empty_error(file)
    vertices = corners.reshape(-1, 3)
    if strict:
        return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    first, numbers = weld(vertices)
    return Mesh(vertices[first], numbers.reshape(-1, 3))


def _is_binary(content: bytes) -> bool:
    """Return whether content is binary; some binary files start with the word 'solid' too."""
    return content[:5].lower() != b"solid" or b"\0" in content[:1024]


def _read_binary(file: str, content: bytes) -> Floats:
    """Return the corners (f, 3, 3) of the triangles."""
    if len(content) < HEADER_BYTES:
        reason = f"{len(content)} bytes are not even the header of an STL file"
        raise truncated_error(file, reason)
    count = int.from_bytes(content[HEADER_BYTES - 4 : HEADER_BYTES], "little")
    expected = HEADER_BYTES + count * FACET.itemsize
    if len(content) < expected:
        raise truncated_error(
            file,
            f"{count} triangles take {expected} bytes, found {len(content)}",
            expected=expected,
            found=len(content),
        )
    facets = np.frombuffer(content, FACET, count=count, offset=HEADER_BYTES)
    return facets["corners"].astype(np.float64)


def _read_ascii(file: str, content: bytes) -> Floats:
    """Return the corners (f, 3, 3) of the triangles, or name the line that is at fault."""
    lines = content.splitlines()
    rows = [line.lstrip()[6:] for line in lines if line.lstrip().startswith(b"vertex")]
    parsed = numbers_by_row(b"\n".join(rows)) if rows else None
    if rows and (parsed is None or (parsed[1] != 3).any()):
        for number, line in enumerate(lines, start=1):
            if not line.lstrip().startswith(b"vertex"):
                continue
            numbers = parse_numbers(line.lstrip()[6:])
            if numbers is None:
                raise unreadable_error(file, "not three numbers", line=number)
            if len(numbers) != 3:
                raise unreadable_error(file, "a vertex needs 3 numbers", line=number)
        raise unreadable_error(file, "not a valid STL file")
    last = next((line for line in reversed(lines) if line.strip()), b"")
    if last.split()[:1] != [b"endsolid"] or len(rows) % 3:
        raise truncated_error(file, "the last line is not 'endsolid'")
    return np.zeros((0, 3, 3)) if parsed is None else parsed[0].reshape(-1, 3, 3)
