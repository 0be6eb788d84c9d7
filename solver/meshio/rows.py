"""The bytes of a file that is small enough to be what it should be."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.surface import Floats, Ints

# The faults every scan format shares, in one wording and with stable codes.


def unreadable(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for content that breaks the format's rules."""
    return InputError("scan.unreadable", f"{file}{_at(where)}: {reason}", file=file, **where)


def truncated(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a file that ends before what it announces."""
    return InputError("scan.truncated", f"{file} is cut short: {reason}", file=file, **where)


def unsupported(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a well-formed file in a form that can not be used."""
    return InputError("scan.format", f"{file}{_at(where)}: {reason}", file=file, **where)


def check_suffix(path: Path, formats: Collection[str]) -> str:
    """Return a file's suffix in small letters; raises ``scan.format`` if it is none of these."""
    suffix = path.suffix.lower()
    if suffix not in formats:
        raise InputError(
            "scan.format",
            f"{path.name}: unknown suffix {suffix!r}; a scan is one of {', '.join(formats)}",
            file=path.name,
            expected=list(formats),
            found=suffix,
        )
    return suffix


def empty(file: str) -> InputError:
    """Return the error for a file without a single vertex."""
    return InputError("scan.empty", f"{file} holds no vertices", file=file)


def wrong_vertex_count(file: str, expected: int, found: int) -> InputError:
    """Return the error for another topology than the template's."""
    return InputError(
        "scan.vertex_count",
        f"{file} has {found} vertices; the template's topology has {expected}; a raw scan is sent "
        "as raw and registered first",
        file=file,
        expected=expected,
        found=found,
    )


def not_finite(file: str, vertex: int, found: object, **where: Any) -> InputError:
    """Return the error for a coordinate that is NaN or infinite; ``vertex`` counts from 0."""
    return InputError(
        "scan.nan",
        f"{file}{_at(where)}: vertex {vertex} is not finite: {found}",
        file=file,
        vertex=vertex,
        found=str(found),
        **where,
    )


def check_finite(file: str, vertices: Floats) -> None:
    """Raise ``scan.nan`` for the first vertex (n, 3) that is not finite."""
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        vertex = int(np.argmax(bad))
        raise not_finite(file, vertex, tuple(vertices[vertex].tolist()))


def _at(where: dict[str, Any]) -> str:
    return f", line {where['line']}" if "line" in where else ""


def read_content(path: Path, limit: int, what: str) -> bytes:
    """Return a file's bytes; ``what`` says in an error what has at most ``limit`` of them.

    Raises :class:`InputError`: ``scan.too_large``, ``scan.unreadable`` or ``scan.empty``.
    """
    try:
        size = path.stat().st_size
        if size > limit:
            raise InputError(
                "scan.too_large",
                f"{path.name} has {size} bytes; {what} has at most {limit}",
                file=path.name,
                expected=limit,
                found=size,
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            "scan.unreadable", f"{path.name} can not be read: {error.strerror}", file=path.name
        ) from None
    if not content.strip():
        raise empty(path.name)
    return content


# What a reader of raw scans returns: the mesh or point cloud as it is stored, unmended.


NO_FACES: Ints = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Mesh:
    """A mesh as a file holds it.

    ``vertices`` (n, 3), in the file's unit, may hold NaN; ``faces`` (f, 3) are triangles, none for
    a point cloud; ``normals`` (n, 3), as stored; ``colours`` (n, 3) in [0, 1]. ``empty_groups``
    are the names of parts that hold no face.
    """

    vertices: Floats
    faces: Ints
    normals: Floats | None = None
    colours: Floats | None = None
    empty_groups: tuple[str, ...] = ()


def unit_colours(colours: Floats) -> Floats:
    """Return colours (n, 3) in [0, 1], given so or as bytes."""
    return np.clip(colours / (255.0 if np.nanmax(colours, initial=0.0) > 1.0 else 1.0), 0.0, 1.0)


def joined(parts: list[Mesh]) -> Mesh:
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


# Rows of numbers in text, a million in a second: what OBJ, PLY and point clouds have in common.


NEWLINE, SPACE = 10, 32


def numbers_by_row(text: bytes) -> tuple[Floats, Ints] | None:
    """Return all numbers of ``text`` in order, and how many each of its lines holds.

    Lines end with a line feed; the last need not. Returns None if anything is not a number, so that
    the caller, who knows the format, can look for the line and name it.
    """
    characters = np.frombuffer(text, np.uint8)
    blank = characters <= SPACE
    starts = np.flatnonzero(~blank & np.concatenate([[True], blank[:-1]]))
    lines = np.flatnonzero(characters == NEWLINE)
    count = len(lines) + (not text.endswith(b"\n"))
    counts = np.bincount(np.searchsorted(lines, starts), minlength=count).astype(np.int64)
    if len(starts) == 0:
        return np.zeros(0), counts
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text.decode("ascii"), dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return None
    return (values, counts) if len(values) == len(starts) else None


def columns(values: Floats, counts: Ints, first: int, last: int) -> Floats:
    """Return columns first to last (not included) of rows that may differ in length, (n, k)."""
    starts = np.cumsum(counts) - counts
    return np.asarray(values[starts[:, None] + np.arange(first, last)], np.float64)


def fan(corners: Ints, counts: Ints) -> Ints:
    """Return the triangles (t, 3) of polygons given by all their corners and corner counts.

    Each polygon is split into a fan around its first corner; one of fewer than 3 gives none.
    """
    pieces = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, pieces)
    step = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


# Rows that are alike, bit by bit: vertices in one place, triangles with the same corners.


MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


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
        mixed = (rows ^ (rows >> np.uint64(29))) * MIXERS
        mixed = (mixed ^ (mixed >> np.uint64(32))) * MIXERS[::-1]
        keys = mixed[:, 0] + mixed[:, 1] + mixed[:, 2]
    _, first, kind = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[kind]
