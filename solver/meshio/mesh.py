"""The mesh that every reader returns, and what formats share: faults, rows of numbers, polygons."""

from __future__ import annotations

import codecs
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError, file_error
from solver.surface import Floats, Ints

Number = TypeVar("Number", bound=np.generic)
NO_FACES: Ints = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Mesh:
    """A mesh or point cloud as its file holds it, unmended; None is what the file has not."""

    vertices: Floats  # (n, 3) in the file's unit; may hold NaN
    faces: Ints = field(default_factory=lambda: NO_FACES)  # (f, 3), none for a point cloud
    normals: Floats | None = None  # (n, 3) as stored
    colours: Floats | None = None  # (n, 3) in [0, 1]
    confidence: Floats | None = None  # (n,) as stored
    empty_groups: tuple[str, ...] = ()  # names of groups, objects or parts without a face


NEARLY_ONE = 1.5  # what rounding, or light, adds to a colour of 1, and a byte does not


def join_meshes(parts: list[Mesh]) -> Mesh:
    """Return several meshes as one; normals and colours stay only if every part has them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    colours = [part.colours for part in parts if part.colours is not None]
    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)]),
        normals=np.concatenate(normals) if len(normals) == len(parts) else None,
        colours=np.concatenate(colours) if len(colours) == len(parts) else None,
        empty_groups=tuple(name for part in parts for name in part.empty_groups),
    )


def unit_colours(colours: Floats) -> Floats:
    """Return colours (n, 3) in [0, 1], given so, or nearly, or as bytes."""
    are_bytes = np.nanmax(colours, initial=0.0) > NEARLY_ONE
    return np.clip(colours / (255.0 if are_bytes else 1.0), 0.0, 1.0)


def fan(corners: Ints, counts: Ints) -> Ints:
    """Return the triangles (t, 3) of polygons given by all their corners and corner counts.

    Each polygon is split into a fan around its first corner; one of fewer than 3 gives none.
    """
    pieces = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, pieces)
    step = count_up(pieces)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


def count_up(lengths: Ints) -> Ints:
    """Return 0, 1, ... up to each of ``lengths``, one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


# The faults that every format shares, in one wording and with stable codes.


# what breaks the format's rules, and what is well-formed in a form that cannot be used
unreadable_error = partial(file_error, "scan.unreadable")
unsupported_error = partial(file_error, "scan.format")


def truncated_error(file: str, reason: str, **where: Any) -> InputError:
    """Return the error for a file that ends before what it announces."""
    return InputError("scan.truncated", f"{file} is cut short: {reason}", file=file, **where)


def empty_error(file: str) -> InputError:
    """Return the error for a file without a single vertex."""
    return InputError("scan.empty", f"{file} holds no vertices", file=file)


def too_large_error(file: str, has: str, found: int, who: str, limit: int) -> InputError:
    """Return the error for a file that ``has`` more than ``who`` may have."""
    message = f"{file} has {found} {has}; {who} has at most {limit}"
    return InputError("scan.too_large", message, file=file, expected=limit, found=found)


def not_finite_error(file: str, vertex: int, found: tuple[float, ...], **where: Any) -> InputError:
    """Return the error for a coordinate that is NaN or infinite; ``vertex`` counts from 0."""
    reason = f"vertex {vertex} is not finite: {found}"
    return file_error("scan.nan", file, reason, vertex=vertex, found=str(found), **where)


def check_finite(file: str, rows: Floats, line: Callable[[int], int] | None = None) -> None:
    """Raise ``scan.nan`` for the first of ``rows`` (n, k), a vertex each, that is not finite.

    In text, ``line`` says where it stands.
    """
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        vertex = int(np.argmax(bad))
        where = {} if line is None else {"line": line(vertex)}
        raise not_finite_error(file, vertex, tuple(rows[vertex].tolist()), **where)


def check_suffix(path: Path, formats: Collection[str]) -> str:
    """Return a file's suffix in small letters; raises ``scan.format`` if it is none of these."""
    suffix = path.suffix.lower()
    file = path.name
    if suffix not in formats:
        message = f"{file}: unknown suffix {suffix!r}; a scan is one of {', '.join(formats)}"
        raise InputError("scan.format", message, file=file, expected=list(formats), found=suffix)
    return suffix


def read_content(path: Path, limit: int, who: str) -> bytes:
    """Return a file's bytes; ``who`` says in an error what has at most ``limit`` of them.

    Raises :class:`InputError`: ``scan.too_large``, ``scan.unreadable`` or ``scan.empty``.
    """
    file = path.name
    try:
        size = path.stat().st_size
        if size > limit:
            raise too_large_error(file, "bytes", size, who, limit)
        content = path.read_bytes()
    except OSError as error:
        message = f"{file} cannot be read: {error.strerror}"
        raise InputError("scan.unreadable", message, file=file) from None
    content = content.removeprefix(codecs.BOM_UTF8)  # some editors put it before text
    if not content.strip():
        raise empty_error(file)
    return content


# Rows of numbers in text, a million in a second: OBJ, PLY, STL and point clouds are made of them.


MAX_DIGITS = 12  # of a count


def parse_count(word: str | bytes) -> int | None:
    """Return a whole number of a few digits; None for anything else."""
    is_count = word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS
    return int(word) if is_count else None


def parse_rows(
    rows: list[bytes], widths: Collection[int] | None = None
) -> tuple[Floats, Ints] | None:
    """Return all numbers of ``rows`` in order, and how many each row holds.

    Returns None if there are no rows, or one that :func:`find_bad_row` finds: something is not a
    number, or the numbers of a row are not as many as one of ``widths``.
    """
    parsed = numbers_by_row(b"\n".join(rows), np.float64) if rows else None
    fits = parsed is not None and (widths is None or np.isin(parsed[1], list(widths)).all())
    return parsed if fits else None


def find_bad_row(
    rows: Iterable[bytes], widths: Collection[int] | None = None
) -> tuple[int, int, bool] | None:
    """Return the first row that :func:`parse_rows` does not take; None if it takes all.

    Returns its number, how many words it has, and whether these are numbers.
    """
    for number, row in enumerate(rows):
        words = len(row.split())
        numbers = parse_numbers(row)
        if numbers is None or (widths is not None and words not in widths):
            return number, words, numbers is not None
    return None


def numbers_by_row(text: bytes, kind: type[Number]) -> tuple[NDArray[Number], Ints] | None:
    """Return the numbers of a ``text`` and how many each of its lines holds.

    Lines are separated by line feeds. Returns None if anything is not a number of that ``kind``:
    1.0 is no whole number.
    """
    characters = np.frombuffer(text, np.uint8)
    blank = characters <= ord(" ")
    starts = np.flatnonzero(~blank & np.concatenate([[True], blank[:-1]]))
    lines = np.flatnonzero(characters == ord("\n"))
    words = np.bincount(np.searchsorted(lines, starts), minlength=len(lines) + 1)
    counts = words.astype(np.int64)
    if not len(starts):
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
    try:
        return None if b"_" in row else [float(word) for word in row.split()]
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
    return first[order].astype(np.int64), np.argsort(order)[kind]
