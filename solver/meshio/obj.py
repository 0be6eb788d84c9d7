"""Wavefront OBJ: every ``v`` line is one vertex, in the order of the file.

Polygons, groups, vertex colours and normals are read too; textures and materials are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from solver.errors import InputError, quote
from solver.meshio.mesh import (
    MAX_DIGITS,
    NO_FACES,
    Mesh,
    columns,
    empty_error,
    fan,
    not_finite_error,
    numbers_by_row,
    parse_numbers,
    parse_rows,
    truncated_error,
    unit_colours,
    unreadable_error,
    unsupported_error,
)
from solver.surface import Floats, Ints, Surface

VERTEX = (b"v ", b"v\t")
FACE = (b"f ", b"f\t")
NORMAL = (b"vn ", b"vn\t")
GROUP = (b"g ", b"g\t", b"o ", b"o\t")
OF_A_MESH = (*NORMAL, b"vt ", b"vt\t", b"mtllib ", b"mtllib\t")  # what comes with faces only
NUMBERS_PER_VERTEX = (3, 4, 6, 7)  # position; with weight; with colour; with both
MOST_UNUSED = 0.05  # share of the vertices in no face: beyond, the file was cut


def read_obj(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return the mesh of OBJ ``content``; without faces it is a point cloud.

    For registered scans (``strict``) coordinates must be finite and no line may be continued, and
    of the rest only faces are checked. Otherwise continued lines are joined, a file that was cut
    off is ``scan.truncated``, and normals, colours and empty groups are returned.

    Raises :class:`InputError`: ``scan.empty``, ``scan.unreadable``, ``scan.truncated``,
    ``scan.format`` or ``scan.nan``, with the ``line`` of the first fault; ``file`` names it.
    """
    if strict:
        if b"\\" in content:
            _check_lines(file, content, strict)
        lines = content.split(b"\n")
    else:
        if content.rstrip().endswith(b"\\"):
            raise truncated_error(file, "the last line announces another")
        lines = re.sub(rb"\\\r?\n", b" ", content).split(b"\n")
    parsed = parse_rows([line[2:] for line in lines if line.startswith(VERTEX)], NUMBERS_PER_VERTEX)
    if parsed is None:
        raise _find_fault(file, content, strict)
    values, counts = parsed
    vertices = columns(values, counts, 0, 3)
    faces_text = b"\n".join(line[2:] for line in lines if line.startswith(FACE))
    faces = _triangles(lines, faces_text, len(vertices))
    if faces is None or (strict and not np.isfinite(vertices).all()):
        raise _find_fault(file, content, strict)
    if strict:
        return Mesh(vertices, faces)
    if not len(faces) and (sign := next((ln for ln in lines if ln.startswith(OF_A_MESH)), None)):
        word = sign.split()[0].decode("ascii")
        raise truncated_error(file, f"it has '{word}' lines, as a mesh has, and no face")
    if not content.endswith(b"\n"):  # without a last line end it may have been cut
        unused = len(vertices) - len(np.unique(faces))
        if not len(faces):
            raise truncated_error(file, "it ends within a line, before the first face")
        if unused > MOST_UNUSED * len(vertices):
            reason = f"it ends without a line end and {unused} vertices are in no face"
            raise truncated_error(file, reason)
    colours = None
    if counts.min() >= 6:  # the last three of each vertex
        colours = unit_colours(values[np.cumsum(counts)[:, None] - np.array([3, 2, 1])])
    normals = _normals(lines, len(vertices), faces_text)
    return Mesh(vertices, faces, normals, colours, empty_groups=_empty_groups(lines))


def write_obj(path: Path, surface: Surface) -> None:
    """Write triangles as Wavefront OBJ, in mm with six decimals."""
    with path.open("w", encoding="ascii") as stream:
        stream.write("# units: mm\n")
        np.savetxt(stream, surface.vertices, fmt="v %.6f %.6f %.6f")
        np.savetxt(stream, surface.faces + 1, fmt="f %d %d %d")


def _triangles(lines: list[bytes], text: bytes, vertices: int) -> Ints | None:
    """Return the triangles (f, 3) of face lines' ``text``; None if there is a fault in it."""
    if not text:
        return NO_FACES
    parsed = numbers_by_row(re.sub(rb"/\S*", b"", text) if b"/" in text else text, np.int64)
    if parsed is None:
        return None
    numbers, counts = parsed
    if counts.min() < 3 or numbers.max() > vertices:
        return None
    if numbers.min() < 0:  # they count back from the vertices before the face
        is_vertex = np.array([line.startswith(VERTEX) for line in lines])
        is_face = np.array([line.startswith(FACE) for line in lines])
        before = np.repeat(np.cumsum(is_vertex)[is_face], counts)
        numbers = np.where(numbers < 0, numbers + before + 1, numbers)
    return fan(numbers - 1, counts) if numbers.min() >= 1 else None


def _normals(lines: list[bytes], vertices: int, faces_text: bytes) -> Floats | None:
    """Return the normals (n, 3), if there is one to each vertex and faces number both alike."""
    rows = [line[3:] for line in lines if line.startswith(NORMAL)]
    parsed = parse_rows(rows, (3,)) if len(rows) == vertices else None
    return parsed[0].reshape(-1, 3) if parsed and _are_alike(faces_text) else None


def _are_alike(faces_text: bytes) -> bool:
    """Return whether all corners are ``a//a`` or ``a/b/a``."""
    pairs = numbers_by_row(re.sub(rb"/\d*/", b" ", faces_text), np.int64)
    if pairs is None or b"-" in faces_text or len(pairs[0]) != 2 * len(faces_text.split()):
        return False
    return bool((pairs[0][::2] == pairs[0][1::2]).all())


def _empty_groups(lines: list[bytes]) -> tuple[str, ...]:
    """Return the names of groups and objects that end up without a single face."""
    has_faces: dict[str, bool] = {}
    unmarked: dict[bytes, list[str]] = {}  # current names that no face was seen for
    for line in lines:
        if line.startswith(GROUP):
            kind, *words = line.split()
            unmarked[kind] = [quote(word.decode("utf-8", "replace")) for word in words]
            for name in unmarked[kind]:
                has_faces.setdefault(name, False)
        elif unmarked and line.startswith(FACE):
            for names in unmarked.values():
                has_faces |= dict.fromkeys(names, True)
            unmarked.clear()
    return tuple(name for name, filled in has_faces.items() if not filled)


# Line by line, for a file that is known to have a fault: which line, and what is wrong there.


def _find_fault(file: str, content: bytes, strict: bool) -> InputError:
    """Return the first fault; in a lenient reading a broken last line without an end is a cut."""
    last = content.count(b"\n") + 1
    try:
        _check_lines(file, content, strict)
    except InputError as error:
        if strict or error.context.get("line") != last or content.endswith(b"\n"):
            return error
        return truncated_error(file, f"line {last}, the last, is not whole", line=last)
    return unreadable_error(file, "not a valid OBJ file")


def _check_lines(file: str, content: bytes, strict: bool) -> None:
    """Raise what is wrong with the first faulty line, or with the highest vertex number."""
    count = 0
    highest = 0
    highest_line = 0
    for line, row in _numbered_lines(content, strict):
        if row.startswith(VERTEX):
            _check_vertex(file, line, row[2:], count, strict)
            count += 1
        elif row.startswith(FACE):
            index = _highest_index(file, line, row, count)
            if index > highest:
                highest = index
                highest_line = line
        elif strict and row.rstrip().endswith(b"\\"):
            raise unsupported_error(file, "continued lines are not supported", line=line)
    if count == 0:
        raise empty_error(file)
    if highest > count:
        reason = f"line {highest_line} uses vertex {highest}, but there are {count}"
        raise truncated_error(file, reason, line=highest_line, expected=highest, found=count)


def _numbered_lines(content: bytes, strict: bool) -> Iterator[tuple[int, bytes]]:
    """Yield lines with their numbers; continued ones joined, under the first's, unless strict."""
    parts: list[bytes] = []
    for line, row in enumerate(content.split(b"\n"), start=1):
        head = row.removesuffix(b"\r")
        if not strict and head.endswith(b"\\"):
            parts.append(head[:-1])
            continue
        yield line - len(parts), b" ".join([*parts, row])
        parts = []


def _check_vertex(file: str, line: int, row: bytes, vertex: int, strict: bool) -> None:
    words = row.split()
    numbers = parse_numbers(row)
    if len(words) not in NUMBERS_PER_VERTEX:
        reason = f"a vertex needs 3 numbers, found {len(words)}"
        raise unreadable_error(file, reason, line=line, vertex=vertex)
    if numbers is None:
        found = quote(b" ".join(words).decode("ascii", "replace"))
        reason = f"not three numbers: '{found}'"
        raise unreadable_error(file, reason, line=line, vertex=vertex, found=found)
    if strict and not all(map(math.isfinite, numbers[:3])):
        raise not_finite_error(file, vertex, tuple(numbers[:3]), line=line)


def _highest_index(file: str, line: int, row: bytes, vertices: int) -> int:
    """Return the highest vertex number (counted from 1) that a face uses."""
    words = row.split()[1:]
    if len(words) < 3:
        raise unreadable_error(file, f"a face needs 3 vertices, found {len(words)}", line=line)
    try:
        numbers = [int(word.partition(b"/")[0]) for word in words]
    except ValueError:
        numbers = []
    if not numbers or max(map(abs, numbers)) >= 10**MAX_DIGITS:
        raise unreadable_error(file, "a face holds what is not a vertex number", line=line)
    if 0 in numbers or min(numbers) < -vertices:
        reason = f"a face uses vertex {min(numbers)}, which is none"
        raise unreadable_error(file, reason, line=line)
    return max(numbers)
