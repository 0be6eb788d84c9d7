"""Wavefront OBJ, read strictly: every ``v`` line is one vertex, in the order of the file."""

from __future__ import annotations

import io
import math
import re
from array import array
from pathlib import Path

import numpy as np

from solver.meshio.rows import (
    Mesh,
    columns,
    empty,
    fan,
    not_finite,
    numbers_by_row,
    truncated,
    unit_colours,
    unreadable,
    unsupported,
)
from solver.surface import Floats, Ints, Surface

NUMBERS_PER_VERTEX = (3, 4, 6, 7)  # position; with weight; with colour; with both


def read_obj(file: str, content: bytes) -> Floats:
    """Return the vertices (n, 3) of OBJ ``content``; ``file`` names it in errors.

    Faces are checked to be whole and within range, and otherwise ignored.
    """
    coordinates = array("d")
    highest, highest_line = 0, 0
    for line, row in enumerate(io.BytesIO(content), start=1):
        if row.startswith((b"v ", b"v\t")):
            coordinates.extend(_vertex(file, line, row, len(coordinates) // 3))
        elif row.startswith((b"f ", b"f\t")):
            index = _highest_index(file, line, row, len(coordinates) // 3)
            if index > highest:
                highest, highest_line = index, line
        elif row.rstrip().endswith(b"\\"):
            raise unsupported(file, "continued lines are not supported", line=line)
    count = len(coordinates) // 3
    if count == 0:
        raise empty(file)
    if highest > count:
        raise truncated(
            file,
            f"line {highest_line} uses vertex {highest}, but there are {count}",
            line=highest_line,
            expected=highest,
            found=count,
        )
    return np.frombuffer(coordinates, dtype=np.float64).reshape(-1, 3).copy()


def write_obj(path: Path, surface: Surface) -> None:
    """Write triangles as Wavefront OBJ, in mm with six decimals."""
    with path.open("w", encoding="ascii") as stream:
        stream.write("# units: mm\n")
        np.savetxt(stream, surface.vertices, fmt="v %.6f %.6f %.6f")
        np.savetxt(stream, surface.faces + 1, fmt="f %d %d %d")


def _vertex(file: str, line: int, row: bytes, vertex: int) -> list[float]:
    words = row.split()[1:]
    if len(words) not in NUMBERS_PER_VERTEX:
        raise unreadable(
            file, f"a vertex needs 3 numbers, found {len(words)}", line=line, vertex=vertex
        )
    try:
        position = [float(word) for word in words[:3]]
    except ValueError:
        found = b" ".join(words[:3]).decode("ascii", "replace")[:60]
        raise unreadable(
            file, f"not three numbers: {found!r}", line=line, vertex=vertex, found=found
        ) from None
    if not all(map(math.isfinite, position)):
        raise not_finite(file, vertex, tuple(position), line=line)
    return position


def _highest_index(file: str, line: int, row: bytes, vertices: int) -> int:
    """Return the highest vertex number (counted from 1) that a face uses."""
    words = row.split()[1:]
    if len(words) < 3:
        raise unreadable(file, f"a face needs 3 vertices, found {len(words)}", line=line)
    try:
        numbers = [int(word.partition(b"/")[0]) for word in words]
    except ValueError:
        raise unreadable(file, "a face holds what is not a vertex number", line=line) from None
    if 0 in numbers or min(numbers) < -vertices:
        raise unreadable(file, f"a face uses vertex {min(numbers)}, which is none", line=line)
    return max(numbers)


# Wavefront OBJ as a raw scan: polygons, groups, vertex colours; textures are left out.


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
