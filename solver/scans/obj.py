"""Wavefront OBJ, read strictly: every ``v`` line is one vertex, in the order of the file."""

from __future__ import annotations

import io
import math
from array import array
from pathlib import Path

import numpy as np

from solver.scans.faults import empty, not_finite, truncated, unreadable, unsupported
from solver.surface import Floats, Surface

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
