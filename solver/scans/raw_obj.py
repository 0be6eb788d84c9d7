"""Wavefront OBJ as a raw scan: polygons, groups, vertex colours; textures are left out."""

from __future__ import annotations

import re

import numpy as np

from solver.scans.faults import empty, truncated, unreadable
from solver.scans.mesh import Mesh, unit_colours
from solver.scans.obj import NUMBERS_PER_VERTEX, read_obj
from solver.scans.rows import columns, fan, numbers_by_row
from solver.surface import Floats, Ints

VERTEX, FACE, NORMAL = (b"v ", b"v\t"), (b"f ", b"f\t"), (b"vn ", b"vn\t")
CUT_SHARE = 0.05
GROUP = (b"g ", b"g\t", b"o ", b"o\t")


def read_raw_obj(file: str, content: bytes) -> Mesh:
    """Return the mesh of OBJ ``content``; without faces it is a point cloud.

    What is wrong in a line is looked for, and named, by the strict reader.
    """
    if content.rstrip().endswith(b"\\"):
        raise truncated(file, "the last line announces another")
    lines = re.sub(rb"\\\r?\n", b" ", content).split(b"\n")
    rows = [line[2:] for line in lines if line.startswith(VERTEX)]
    if not rows:
        raise empty(file)
    parsed = numbers_by_row(b"\n".join(rows))
    if parsed is None or not np.isin(parsed[1], NUMBERS_PER_VERTEX).all():
        raise _named(file, content)
    values, counts = parsed
    vertices = columns(values, counts, 0, 3)
    colours = None
    if counts.min() >= 6:
        weights = int(counts[0]) - 6
        colours = unit_colours(columns(values, counts, 3 + weights, 6 + weights))
    faces, faces_text = _faces(file, content, lines, len(vertices))
    if not len(faces) and not content.endswith(b"\n"):
        raise truncated(file, "it ends within a line, before the first face")
    if not content.endswith(b"\n"):
        unused = len(vertices) - len(np.unique(faces))
        if unused > CUT_SHARE * len(vertices):
            raise truncated(
                file, f"it ends without a line end and {unused} vertices are in no face"
            )
    return Mesh(
        vertices=vertices,
        faces=faces,
        normals=_normals(lines, len(vertices), faces_text),
        colours=colours,
        empty_groups=_empty_groups(lines),
    )


def _faces(file: str, content: bytes, lines: list[bytes], vertices: int) -> tuple[Ints, bytes]:
    """Return the triangles (f, 3) and the text they came from."""
    text = b"\n".join(line[2:] for line in lines if line.startswith(FACE))
    if not text:
        return np.zeros((0, 3), np.int64), text
    parsed = numbers_by_row(re.sub(rb"/\S*", b"", text) if b"/" in text else text)
    if parsed is None:
        raise _named(file, content)
    numbers, counts = parsed[0].astype(np.int64), parsed[1]
    if (numbers < 0).any():
        before = np.repeat(_vertices_before_faces(lines), counts)
        numbers = np.where(numbers < 0, numbers + before + 1, numbers)
    if counts.min() < 3 or numbers.min() < 1 or numbers.max() > vertices:
        raise _named(file, content)
    return fan(numbers - 1, counts), text


def _vertices_before_faces(lines: list[bytes]) -> Ints:
    """Return how many vertices precede each face: negative numbers count back from there."""
    is_vertex = np.array([line.startswith(VERTEX) for line in lines])
    is_face = np.array([line.startswith(FACE) for line in lines])
    return np.asarray(np.cumsum(is_vertex)[is_face], np.int64)


def _normals(lines: list[bytes], vertices: int, faces_text: bytes) -> Floats | None:
    """Return the normals (n, 3), if there is one to each vertex and faces number both alike."""
    rows = [line[3:] for line in lines if line.startswith(NORMAL)]
    parsed = numbers_by_row(b"\n".join(rows)) if len(rows) == vertices else None
    if parsed is None or (parsed[1] != 3).any():
        return None
    corner = re.compile(rb"(\d+)/\d*/\1(?=\s|$)")
    if faces_text and corner.sub(b"", faces_text).strip():
        return None
    return parsed[0].reshape(-1, 3)


def _empty_groups(lines: list[bytes]) -> tuple[str, ...]:
    """Return the names of groups and objects that end up without a single face."""
    named: dict[str, bool] = {}
    current: dict[bytes, list[str]] = {}
    for line in lines:
        if line.startswith(GROUP):
            kind, *words = line.split()
            current[kind] = [word.decode("utf-8", "replace")[:60] for word in words]
            for name in current[kind]:
                named.setdefault(name, False)
        elif current and line.startswith(FACE):
            named |= dict.fromkeys((name for names in current.values() for name in names), True)
    return tuple(name for name, has_faces in named.items() if not has_faces)


def _named(file: str, content: bytes) -> Exception:
    """Return the fault with its line; a broken last line without an end is a cut."""
    last = content.count(b"\n") + 1
    try:
        read_obj(file, content)
    except ValueError as error:
        context = getattr(error, "context", {})
        if context.get("line") == last and not content.endswith(b"\n"):
            return truncated(file, f"line {last}, the last, is not whole", line=last)
        return error
    return unreadable(file, "not a valid OBJ file")
