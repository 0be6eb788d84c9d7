"""STL as a raw scan: loose triangles, joined where their corners are one place."""

from __future__ import annotations

import numpy as np

from solver.errors import InputError
from solver.meshio.rows import (
    Mesh,
    check_finite,
    empty,
    numbers_by_row,
    truncated,
    unreadable,
    unsupported,
    weld,
)
from solver.surface import Floats, Ints

# STL (ascii and binary): loose triangles, given vertex numbers through the template's faces.


HEADER_BYTES = 84
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
SAME_PLACE_MM = 0.01


def read_stl(file: str, content: bytes, faces: Ints, vertex_count: int) -> Floats:
    """Return the vertices (n, 3) of STL ``content`` in the template's order.

    STL shares no vertices, so its facets must be the template's ``faces`` (f, 3) in the same order;
    corners that are one vertex in the template must lie in one place.
    """
    corners = read_facets(file, content)
    if len(corners) == 0:
        raise empty(file)
    if len(corners) != len(faces):
        raise InputError(
            "scan.vertex_count",
            f"{file} has {len(corners)} triangles; the template has {len(faces)}",
            file=file,
            expected=len(faces),
            found=len(corners),
        )
    check_finite(file, corners.reshape(-1, 3))
    return _numbered(file, corners, faces, vertex_count)


def read_facets(file: str, content: bytes) -> Floats:
    """Return the corners (f, 3, 3) of the triangles of STL ``content``."""
    if not content:
        raise empty(file)
    return _ascii(file, content) if _is_ascii(content) else _binary(file, content)


def _numbered(file: str, corners: Floats, faces: Ints, vertex_count: int) -> Floats:
    vertices = np.full((vertex_count, 3), np.nan)
    vertices[faces.ravel()] = corners.reshape(-1, 3)
    loose = np.flatnonzero(np.isnan(vertices[:, 0]))
    if len(loose):
        raise unsupported(
            file,
            f"STL can not carry vertex {loose[0]}, which is in no triangle: use OBJ, PLY or GLB",
            vertex=int(loose[0]),
        )
    apart = np.abs(vertices[faces] - corners).max(axis=(1, 2))
    if apart.max() > SAME_PLACE_MM:
        triangle = int(np.argmax(apart > SAME_PLACE_MM))
        raise InputError(
            "scan.vertex_order",
            f"{file}: triangle {triangle} does not meet its neighbours as in the template; "
            "the triangles must be the template's, in the same order",
            file=file,
            triangle=triangle,
        )
    return vertices


def _is_ascii(content: bytes) -> bool:
    """Tell ascii from binary; some binary files start with the word 'solid' too."""
    return content[:5].lower() == b"solid" and b"\0" not in content[:1024]


def _binary(file: str, content: bytes) -> Floats:
    if len(content) < HEADER_BYTES:
        raise truncated(file, f"{len(content)} bytes are not even the header of an STL file")
    count = int.from_bytes(content[80:84], "little")
    expected = HEADER_BYTES + count * FACET.itemsize
    if len(content) < expected:
        raise truncated(
            file,
            f"{count} triangles take {expected} bytes, found {len(content)}",
            expected=expected,
            found=len(content),
        )
    facets = np.frombuffer(content, FACET, count=count, offset=HEADER_BYTES)
    return facets["corners"].astype(np.float64)


def _ascii(file: str, content: bytes) -> Floats:
    rows = [row.lstrip()[6:] for row in content.split(b"\n") if row.lstrip().startswith(b"vertex")]
    parsed = numbers_by_row(b"\n".join(rows)) if rows else None
    ends = content.rstrip().rpartition(b"\n")[2].split()[:1] == [b"endsolid"]
    if parsed is not None and (parsed[1] == 3).all() and len(rows) % 3 == 0 and ends:
        return parsed[0].reshape(-1, 3, 3)
    return _ascii_line_by_line(file, content)


def _ascii_line_by_line(file: str, content: bytes) -> Floats:
    """Return the same, or name the line that is at fault."""
    corners: list[list[float]] = []
    ended = False
    for line, row in enumerate(content.splitlines(), start=1):
        words = row.split()
        if not words:
            continue
        if words[0] == b"vertex":
            try:
                corners.append([float(word) for word in words[1:]])
            except ValueError:
                raise unreadable(file, "not three numbers", line=line) from None
            if len(corners[-1]) != 3:
                raise unreadable(file, "a vertex needs 3 numbers", line=line)
        ended = words[0] == b"endsolid"
    if not ended or len(corners) % 3:
        raise truncated(file, "the last line is not 'endsolid'")
    return np.array(corners, dtype=np.float64).reshape(-1, 3, 3)


def read_raw_stl(file: str, content: bytes) -> Mesh:
    """Return the mesh of STL ``content`` (ascii or binary)."""
    corners = read_facets(file, content)
    if len(corners) == 0:
        raise empty(file)
    first, numbers = weld(corners.reshape(-1, 3))
    return Mesh(corners.reshape(-1, 3)[first], numbers.reshape(-1, 3))
