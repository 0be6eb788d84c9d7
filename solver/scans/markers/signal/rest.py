"""The choice of the second in which a face is at rest, among all in which it is still.

People hold expressions as still as they rest. But between expressions a face comes back to rest:
still seconds are compared with the whole take, without the head's motion, and rest is the pose that
is visited most often. Between two that are held about as long, the mouth more closed decides;
nothing but a look at them can tell for sure, so that the other is kept as a rival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.errors import MOST_NAMES, quote
from solver.scans.markers.readers.names import LOWER, Named
from solver.scans.markers.signal.faults import Faults, runs
from solver.scans.markers.signal.motion import (
    Mask,
    Second,
    median_of_seen,
    rms_of_seen,
    still_seconds,
)
from solver.surface import Floats


@dataclass(frozen=True)
class RestOptions:
    """Settings of the choice; lengths in mm, times in s."""

    seconds: int = 30  # still ones that are compared with the take
    unrest: float = 1.0  # that a still face moves in half a second, rms of its markers
    block: float = 0.25  # of the take, whose median is one place of a marker
    alike: float = 5.0  # no marker farther elsewhere: the same pose
    least: int = 3  # markers seen in both, to compare poses
    visit: int = 2  # blocks in a pose that are a visit
    apart: float = 6.0  # some marker farther elsewhere: another pose
    poses: int = 3  # at most, that may be rest
    rival: float = 0.7  # of the time in the chosen pose: another may be rest as well
    closed: float = (
        2.0  # nearer are lower lip and chin to the rest of the face: a mouth more closed
    )
    named: int = 4  # labels in a sentence


REST = RestOptions()


@dataclass(frozen=True, eq=False)
class Rest:
    """A still second in which the face may be at rest."""

    second: Second
    places: Floats  # (k, 3) in the head's frame, NaN for what is wrong or missing in it
    visits: int  # times at which the face comes to this pose
    share: float  # of the still time in it
    opening: float  # mm of lower lip and chin from the middle of the other markers; 0 without them

    @property
    def rows(self) -> tuple[int, int]:
        """Return its first and last row."""
        return self.second.rows

    def apart(self, other: Rest) -> Floats:
        """Return how far markers (k,) lie from where they are in another, NaN for those unseen."""
        return np.asarray(np.linalg.norm(self.places - other.places, axis=1))


def likely_rests(faults: Faults, names: Sequence[Named | None], rate: float) -> list[Rest]:
    """Return different poses in which the face may be at rest, the likeliest first, one at least.

    ``names`` are those of the markers. :func:`rivals` tells which of the others may be rest as
    well as the first.
    """
    motion = faults.motion
    places = np.where(_mark_telling(faults, names)[..., None], motion.places, np.nan)
    blocks = _blocks(places, rate)
    is_still = _still(blocks)
    found: list[Rest] = []
    for second in still_seconds(motion, rate, REST.seconds):
        first, last = second.rows
        own = places[first : last + 1]
        spread = np.nanvar(own[:, np.isfinite(own[..., 0]).any(axis=0)], axis=0).sum(axis=1)
        if found and np.sqrt(spread.mean()) > REST.unrest:
            continue
        at = median_of_seen(own)
        near = _is_alike(blocks, at)
        visits = sum(b - a + 1 >= REST.visit for a, b in runs(near, 1))
        share = float((near & is_still).sum() / max(is_still.sum(), 1))
        found.append(Rest(second, at, visits, share, _opening(at, names)))
    found.sort(key=lambda each: (-each.visits, each.second.unrest))
    different: list[Rest] = []
    for each in found:
        apart = [np.nan_to_num(each.apart(other)) for other in different]
        if all((mm > REST.apart).any() for mm in apart):
            different.append(each)
    best = different[0]
    for each in rivals(best, different):
        if each.opening < best.opening - REST.closed:
            best = each
    others = sorted((each for each in different if each is not best), key=lambda each: -each.share)
    return [best, *others][: REST.poses]


def rivals(chosen: Rest, rests: Sequence[Rest]) -> list[Rest]:
    """Return the other poses that are held about as long as the chosen one, the longest first."""
    least = REST.rival * chosen.share
    held = [each for each in rests if each is not chosen and each.share >= max(least, 1e-9)]
    return sorted(held, key=lambda each: -each.share)


def compare_rests(
    rest: Rest, rival: Rest, labels: Sequence[str], numbers: Sequence[int]
) -> dict[str, Any]:
    """Return the message and figures of a rest with a rival, of a take with such frames."""
    spans = [[numbers[row] for row in each.rows] for each in (rest, rival)]
    apart = np.nan_to_num(rest.apart(rival))
    elsewhere = [
        {"label": labels[each], "mm": round(float(apart[each]), 1)}
        for each in np.argsort(-apart).tolist()
        if apart[each] > REST.alike
    ]
    shown = elsewhere[: REST.named]
    named = [f"{quote(each['label'])} by {each['mm']:.1f} mm" for each in shown]
    (first, last), (one, other) = spans
    message = (
        f"The face is still in frames {first} to {last}, taken for rest, and held about as long "
        f"as in frames {one} to {other}, where markers lie elsewhere: {', '.join(named)}."
    )
    figures = {"label": elsewhere[0]["label"], "found": elsewhere[0]["mm"]}
    return {"message": message, "frames": spans, "elsewhere": elsewhere[:MOST_NAMES], **figures}


def _mark_telling(faults: Faults, names: Sequence[Named | None]) -> Mask:
    """Return which points (f, k) tell poses apart: right ones of markers that stay in place.

    Lids do not: they blink.
    """
    usable = faults.usable.copy()
    usable[:, list(faults.moved)] = False
    usable[:, [name is not None and name.region == "lid" for name in names]] = False
    return usable


def _blocks(places: Floats, rate: float) -> Floats:
    """Return median places (b, k, 3) in each part of the take."""
    size = max(1, min(round(REST.block * rate), len(places)))
    count = len(places) // size
    return median_of_seen(
        places[: count * size].reshape(count, size, *places.shape[1:]).swapaxes(0, 1)
    )


def _still(blocks: Floats) -> Mask:
    """Return in which blocks (b,) the face hardly moves from the one before to the one after."""
    numbers = np.arange(len(blocks))
    before = np.maximum(numbers - 1, 0)
    after = np.minimum(numbers + 1, len(blocks) - 1)
    way = np.linalg.norm(blocks[after] - blocks[before], axis=2)
    return np.array([rms_of_seen(each) <= REST.unrest for each in way], bool)


def _is_alike(blocks: Floats, at: Floats) -> Mask:
    """Return in which blocks (b,) no marker is far from where it is ``at`` (k, 3)."""
    off = np.linalg.norm(blocks - at, axis=2)
    enough = np.isfinite(off).sum(axis=1) >= REST.least
    return np.asarray(enough & ~(np.nan_to_num(off) > REST.alike).any(axis=1))


def _opening(places: Floats, names: Sequence[Named | None]) -> float:
    """Return how far lower lip and chin lie from the middle of the other markers, mm."""
    is_lower = np.array([each is not None and each.region in LOWER for each in names], bool)
    seen = np.isfinite(places[:, 0])
    if not (seen & is_lower).any() or not (seen & ~is_lower).any():
        return 0.0
    middle = places[seen & ~is_lower].mean(axis=0)
    return float(np.linalg.norm(places[seen & is_lower] - middle, axis=1).mean())
