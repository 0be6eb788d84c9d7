"""The mesh that every reader returns; rows of numbers and polygons, which formats share."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from solver.surface import Floats, Ints

Number = TypeVar("Number", bound=np.generic)
NO_FACES: Ints = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Mesh:
    """A mesh or point cloud as its file holds it, unmended.

    vertices
        (n, 3) in the file's unit; may hold NaN.
    faces
        (f, 3) triangles, none for a point cloud.
    normals, colours
        (n, 3) as stored, and (n, 3) in [0, 1]; None where the file has none.
    confidence
        (n,) as stored; None where the file has none.
    empty_groups
        Names of groups, objects or parts that hold no face.
    """

    vertices: Floats
    faces: Ints = field(default_factory=lambda: NO_FACES)
    normals: Floats | None = None
    colours: Floats | None = None
    confidence: Floats | None = None
    empty_groups: tuple[str, ...] = ()


def join_meshes(parts: list[Mesh]) -> Mesh:
    """Return several meshes as one; normals and colours stay only if every part has them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])

    def all_of(values: list[Floats | None]) -> Floats | None:
        known = [value for value in values if value is not None]
        return np.concatenate(known) if known and len(known) == len(parts) else None

    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate(
            [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
        ),
        normals=all_of([part.normals for part in parts]),
        colours=all_of([part.colours for part in parts]),
        empty_groups=tuple(name for part in parts for name in part.empty_groups),
    )


def unit_colours(colours: Floats) -> Floats:
    """Return colours (n, 3) in [0, 1], given so or as bytes."""
    return np.clip(colours / (255.0 if np.nanmax(colours, initial=0.0) > 1.0 else 1.0), 0.0, 1.0)


def fan(corners: Ints, counts: Ints) -> Ints:
    """Return the triangles (t, 3) of polygons given by all their corners and corner counts.

    Each polygon is split into a fan around its first corner; one of fewer than 3 gives none.
    """
    pieces = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, pieces)
    step = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


# Rows of numbers in text, a million in a second: OBJ, PLY, STL and point clouds are made of them.


def numbers_by_row(text: bytes) -> tuple[Floats, Ints] | None:
    """Return all numbers of ``text`` in order, and how many each of its lines holds.

    Lines are separated by line feeds. Returns None if anything is not a number, so that the caller,
    who knows the format, can look for the line and name it.
    """
    return _by_row(text, np.float64)


def whole_numbers_by_row(text: bytes) -> tuple[Ints, Ints] | None:
    """Do as :func:`numbers_by_row` for whole numbers: anything else, 1.0 too, gives None."""
    return _by_row(text, np.int64)


def _by_row(text: bytes, kind: type[Number]) -> tuple[NDArray[Number], Ints] | None:
    characters = np.frombuffer(text, np.uint8)
    blank = characters <= ord(" ")
    starts = np.flatnonzero(~blank & np.concatenate([[True], blank[:-1]]))
    lines = np.flatnonzero(characters == ord("\n"))
    words = np.bincount(np.searchsorted(lines, starts), minlength=len(lines) + 1)
    counts = words.astype(np.int64)
    if len(starts) == 0:
        return np.zeros(0, kind), counts
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text.decode("ascii"), dtype=kind, sep=" ")
        except (ValueError, DeprecationWarning):
            return None
    return (values, counts) if len(values) == len(starts) else None


def parse_numbers(row: bytes) -> list[float] | None:
    """Return the numbers of one row, None if it holds anything else: slow, to find a fault."""
    words = row.split()
    try:
        return None if b"_" in row else [float(word) for word in words]
    except ValueError:
        return None


def columns(values: Floats, counts: Ints, first: int, last: int) -> Floats:
    """Return columns first to last (not included) of rows that may differ in length, (n, k)."""
    starts = np.cumsum(counts) - counts
    return np.asarray(values[starts[:, None] + np.arange(first, last)], np.float64)


# Rows that are alike, bit by bit: vertices in one place, triangles with the same corners.

# Odd constants of 64-bit hashes (golden ratio; xxHash), one for each column.
_MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def weld(vertices: Floats) -> tuple[Ints, Ints]:
    """Return the first vertex of each place (k,), ascending, and the place of each vertex (n,).

    Places are compared bit by bit: files write one corner alike everywhere.
    """
    return alike(np.ascontiguousarray(vertices + 0.0).view(np.uint64))  # -0.0 becomes 0.0


def alike(rows: NDArray[np.uint64]) -> tuple[Ints, Ints]:
    """Return the first of each kind of row (k,), ascending, and the kind of each row (n,).

    Rows (n, 3) are compared by a 64-bit hash, whose chance of a false match is below 1e-5.
    """
    with np.errstate(over="ignore"):
        mixed = (rows ^ (rows >> np.uint64(29))) * _MIXERS
        mixed = (mixed ^ (mixed >> np.uint64(32))) * _MIXERS[::-1]
        keys = mixed[:, 0] + mixed[:, 1] + mixed[:, 2]
    _, first, kind = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[kind]
