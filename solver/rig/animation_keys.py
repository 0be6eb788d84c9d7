"""Fewer keys: frames that lie between others, as near as can be seen, are left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from solver.surface import Floats, Ints

Error = Callable[[int, int, Ints], Floats]
"""How far frames (k,) between two others are off, mm, where those two are the only keys."""


def needed_keys(frames: int, error: Error, within_mm: float) -> Ints:
    """Return the frames (k,) that keep all others within so much (Douglas and Peucker 1973)."""
    if frames < 3:
        return np.arange(frames)
    kept = {0, frames - 1}
    open_ends = [(0, frames - 1)]
    while open_ends:
        first, last = open_ends.pop()
        between = np.arange(first + 1, last)
        if not len(between):
            continue
        off = error(first, last, between)
        if off.max() > within_mm:
            worst = int(between[off.argmax()])
            kept.add(worst)
            open_ends += [(first, worst), (worst, last)]
    return np.array(sorted(kept))
