"""Swaps of two labels, from the frame in which they cross to the one in which they cross back.

In a frame in which two labels are exchanged each marker leaps to where the other was, which no skin
does. So a swap is found whatever the face does meanwhile, and however long it lasts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from solver.scans.markers.signal.motion import Mask
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class CrossingOptions:
    """Limits of crossings; lengths by how far the two markers lie apart, times in s."""

    least_mm: float = 4.0  # apart: nearer ones cross in lips, too
    near: float = 0.4  # of where the other was a leap ends
    hidden: float = 0.25  # at most before it: markers move meanwhile
    confirmed: float = 0.5  # s after a crossing without return that have to look exchanged


CROSSING = CrossingOptions()


@dataclass(frozen=True)
class Swap:
    """Frames ``rows`` in which two labels have each other's marker."""

    a: int
    b: int
    rows: Ints


def find_swaps(
    places: Floats, expected: Floats, pairs: Iterable[tuple[int, int]], leap_mm: float, rate: float
) -> list[Swap]:
    """Return the swaps of ``pairs`` of markers at ``places`` (f, k, 3), in the head's frame.

    A marker that goes farther than ``leap_mm`` in a frame has leapt. Labels are right in most
    frames; those of a swap that does not end are compared with where they are ``expected``
    (f, k, 3).
    """
    before, since = _places_before(places)
    with np.errstate(invalid="ignore"):
        way = np.linalg.norm(places - before, axis=2)
        leaps = (way > leap_mm) & (since <= max(1, round(CROSSING.hidden * rate)))
    found, taken = [], np.zeros(leaps.shape, bool)
    for a, b in pairs:
        at = np.flatnonzero(leaps[:, a] & leaps[:, b])
        at = at[_is_crossing(places[at][:, [a, b]], before[at][:, [a, b]])]
        for rows in _find_swaps(places, expected, (a, b), at, rate):
            free = rows[~(taken[rows, a] | taken[rows, b])]
            if len(free):
                taken[free, a] = taken[free, b] = True
                found.append(Swap(a, b, free))
    return found


def exchange(points: Floats, swaps: Iterable[Swap]) -> Floats:
    """Return ``points`` (f, k, 3) with the markers of swapped labels exchanged."""
    right = points.copy()
    for swap in swaps:
        right[swap.rows, swap.a] = points[swap.rows, swap.b]
        right[swap.rows, swap.b] = points[swap.rows, swap.a]
    return right


def _places_before(places: Floats) -> tuple[Floats, Ints]:
    """Return where markers (f, k, 3) were seen last before each frame, and how many frames ago."""
    seen = np.isfinite(places[..., 0])
    numbers = np.arange(len(places))[:, None]
    last = np.maximum.accumulate(np.where(seen, numbers, -1), axis=0)
    last = np.concatenate([np.full((1, seen.shape[1]), -1), last[:-1]])
    before = places[np.maximum(last, 0), np.arange(seen.shape[1])]
    before[last < 0] = np.nan
    return before, numbers - last


def _is_crossing(now: Floats, before: Floats) -> Mask:
    """Return at which of n leaps two markers (n, 2, 3) came to where the other was ``before``."""
    apart = np.linalg.norm(before[:, 0] - before[:, 1], axis=1)
    off = np.linalg.norm(now - before[:, ::-1], axis=2).max(axis=1, initial=0.0)
    return np.asarray((apart > CROSSING.least_mm) & (off < CROSSING.near * apart))


def _find_swaps(
    places: Floats, expected: Floats, pair: tuple[int, int], crossings: Ints, rate: float
) -> Iterator[Ints]:
    """Yield the rows of each swap of a ``pair``, between a crossing and the next."""
    if not len(crossings):
        return
    a, b = pair
    seen = np.asarray(np.isfinite(places[:, [a, b], 0]).any(axis=1))
    phase = np.zeros(len(places), int)
    phase[crossings] = 1
    phase = np.cumsum(phase)
    swapped = np.bincount(phase[seen] % 2, minlength=2)
    if swapped[1] > swapped[0]:  # labels are right for longer than not
        phase += 1
    for number in np.unique(phase[phase % 2 == 1]).tolist():
        rows = np.flatnonzero(phase == number)
        # a swap that ends has crossed twice; one crossing alone may be something else
        is_closed = rows[0] > 0 and rows[-1] + 1 < len(places)
        if is_closed or _look_exchanged(places, expected, pair, rows, rate):
            yield rows[seen[rows]]


def _look_exchanged(
    places: Floats, expected: Floats, pair: tuple[int, int], rows: Ints, rate: float
) -> bool:
    """Tell whether two markers lie where the other is expected, beside where they crossed."""
    count = max(1, round(CROSSING.confirmed * rate))
    near = rows[:count] if rows[0] > 0 else rows[-count:]
    here, there = list(pair), list(pair[::-1])
    own = np.linalg.norm(places[near][:, here] - expected[near][:, here], axis=2)
    crossed = np.linalg.norm(places[near][:, here] - expected[near][:, there], axis=2)
    gain = own - crossed
    gain = gain[np.isfinite(gain)]
    return bool(len(gain) and np.median(gain) > 0.0)
