"""Rows of numbers in text, a million in a second: what OBJ, PLY and point clouds have in common."""

from __future__ import annotations

import warnings

import numpy as np

from solver.surface import Floats, Ints

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
