"""The motion of a take taken apart: the head's, what the face does, and what neither explains.

Markers of one face move together: after the head's rigid motion a few shapes explain them all. The
shapes are learnt from how markers move within parts of a second, so that a marker that jumps once,
or falls off, does not teach its jump. A frame is then explained by most of its markers (Geman &
McClure 1987), and what is left over of each is its residual.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.similarity import robust_weights, weighted_motions
from solver.surface import Floats, Ints

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class TakeApartOptions:
    """Settings of taking a motion apart; lengths in mm, times in s."""

    head_rounds: int = 4  # of head motion and middle face in turns
    head_slack: float = 3.0  # off the middle face by more: little weight in the head's motion
    least_markers: int = 3  # that give a head's motion
    lags: tuple[float, ...] = (0.1, 0.4)  # over which shapes are learnt
    pairs: int = 1500  # of frames at most that teach, for each lag
    usual: float = 0.9  # quantile of a marker's motion in a lag ...
    jump: tuple[float, float] = (3.0, 1.0)  # ... more than a x it + b counts as so much
    markers_a_shape: int = 4  # so many markers allow one shape more ...
    most_shapes: int = 12  # ... up to these
    slacks: tuple[float, ...] = (10.0, 6.0, 4.0, 3.0, 2.0, 2.0)  # of what explains a frame
    together: float = 3.5  # markers that a shape is of, at least: others explain only themselves
    noise: float = 1.5  # off the shapes; how much a frame's weights keep to what is usual


MOTION = TakeApartOptions()


@dataclass(frozen=True)
class Motion:
    """A take of k markers in f frames, taken apart; in the head's frame, in mm."""

    rotations: Floats  # (f, 3, 3) into the head's frame: rotations @ x + shifts
    shifts: Floats  # (f, 3)
    middle: Floats  # (k, 3) the median face, NaN for a marker that is never seen
    places: Floats  # (f, k, 3) markers in the head's frame, NaN where missing
    expected: Floats  # (f, k, 3) where most of the markers put them

    @property
    def residuals(self) -> Floats:
        """Return what is left over (f, k, 3), NaN where a marker is missing."""
        return np.asarray(self.places - self.expected)


def take_apart(positions: Floats, rate: float) -> Motion:
    """Return the motion of markers (f, k, 3), NaN where missing, at ``rate`` frames a second.

    The head's frame is that of the frame with the most markers.
    """
    rotations, shifts, middle = _hold_head(positions)
    places = np.einsum("fij,fkj->fki", rotations, positions, optimize=True) + shifts[:, None]
    changes = places - middle
    shapes, spread = _learn_shapes(changes, rate)
    expected = middle + _explain(changes, shapes, spread)
    return Motion(rotations, shifts, middle, places, expected)


def median_of_seen(values: Floats) -> Floats:
    """Return the median over frames, NaN where nothing is seen in any."""
    seen = np.isfinite(values).any(axis=0)
    found = np.full(values.shape[1:], np.nan)
    if seen.any():
        found[seen] = np.nanmedian(values[:, seen], axis=0)
    return found


def rms_of_seen(distances: Floats) -> float:
    """Return the root mean square of what is not NaN, 0 if nothing is."""
    seen = distances[np.isfinite(distances)]
    return float(np.sqrt((seen**2).mean())) if len(seen) else 0.0


def _hold_head(positions: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rotations and shifts into the head's frame, and the median face there."""
    seen = np.isfinite(positions[..., 0])
    points = np.nan_to_num(positions)
    middle = positions[int(np.argmax(seen.sum(axis=1)))].copy()
    weights = seen.astype(float)
    for _ in range(MOTION.head_rounds):
        known = np.isfinite(middle[:, 0])
        rotations, shifts = weighted_motions(points, np.nan_to_num(middle), weights * known)
        is_placed = (seen & known).sum(axis=1) >= MOTION.least_markers
        if is_placed.any():  # other frames keep the motion before, the first ones the next
            last = last_true(is_placed)
            last[last < 0] = int(np.argmax(is_placed))
            rotations = rotations[last]
            shifts = shifts[last]
        placed = np.einsum("fij,fkj->fki", rotations, positions, optimize=True) + shifts[:, None]
        middle = median_of_seen(placed)
        off = np.nan_to_num(np.linalg.norm(placed - middle, axis=2))
        usual = np.sqrt((off**2 * weights).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-12))
        weights = robust_weights((off / MOTION.head_slack) ** 2)
        weights *= seen / (1 + (usual / MOTION.head_slack) ** 2)
    return rotations, shifts, middle


def last_true(mask: Mask) -> Ints:
    """Return the row of the last True up to each row of a mask (f, ...), -1 before the first."""
    rows = np.arange(len(mask)).reshape(-1, *[1] * (mask.ndim - 1))
    return np.maximum.accumulate(np.where(mask, rows, -1), axis=0)


def _learn_shapes(changes: Floats, rate: float) -> tuple[Floats, Floats]:
    """Return shapes (r, k, 3) in which markers move together, and their usual squares (r,)."""
    frames, count = changes.shape[:2]
    total = np.zeros((3 * count, 3 * count))
    pairs = np.full((count, count), 1e-9)
    for lag in MOTION.lags:
        step = max(1, round(lag * rate))
        starts = np.arange(0, frames - step, max(1, (frames - step) // MOTION.pairs))
        if not len(starts):
            continue
        change = changes[starts + step] - changes[starts]
        seen = np.isfinite(change[..., 0])
        length = np.linalg.norm(np.nan_to_num(change), axis=2)
        factor, more = MOTION.jump
        known = seen.any(axis=0)
        most = np.zeros(count)
        most[known] = np.nanquantile(np.where(seen, length, np.nan)[:, known], MOTION.usual, axis=0)
        most = factor * most + more
        change = np.nan_to_num(change) * np.minimum(1.0, most / (length + 1e-9))[..., None]
        flat = change.reshape(len(change), -1)
        total += flat.T @ flat
        pairs += seen.astype(float).T @ seen
    squares, vectors = np.linalg.eigh(total / np.repeat(np.repeat(pairs, 3, 0), 3, 1))
    number = int(min(MOTION.most_shapes, count // MOTION.markers_a_shape, frames // 4))
    shapes = vectors.T.reshape(-1, count, 3)
    share = (shapes**2).sum(axis=2)
    kept = np.flatnonzero((squares > 1e-9) & ((share**2).sum(axis=1) * MOTION.together < 1.0))
    kept = kept[np.argsort(-squares[kept])][:number]
    return np.ascontiguousarray(shapes[kept]), squares[kept]


def _explain(changes: Floats, shapes: Floats, spread: Floats) -> Floats:
    """Return the motion (f, k, 3) by the shapes that most markers of each frame agree with."""
    if not len(shapes):
        return np.zeros_like(changes)
    seen = np.isfinite(changes[..., 0])
    goal = np.nan_to_num(changes)
    products = np.einsum("rki,ski->krs", shapes, shapes).reshape(shapes.shape[1], -1)
    keep = np.diag(MOTION.noise**2 / (4 * spread))
    weights = seen.astype(float)
    found = np.zeros_like(goal)
    flat = shapes.reshape(len(shapes), -1)
    for slack in MOTION.slacks:
        left = (weights @ products).reshape(-1, len(shapes), len(shapes)) + keep
        right = (goal * weights[..., None]).reshape(len(goal), -1) @ flat.T
        shares = np.linalg.solve(left, right[..., None])[..., 0]
        found = (shares @ flat).reshape(goal.shape)
        off = ((goal - found) ** 2).sum(axis=2)
        weights = seen * robust_weights(off / slack**2)
    return found


@dataclass(frozen=True)
class NeutralOptions:
    """Bounds by which a neutral is judged; lengths in mm."""

    seconds: float = 1.0
    away: float = 0.05  # of unrest that a mm away from the median face counts as
    seen: float = 0.8  # of the most markers must be seen


NEUTRAL = NeutralOptions()


@dataclass(frozen=True)
class Second:
    """First and last row of a second, and how much the face stirs in it, mm."""

    rows: tuple[int, int]
    unrest: float = 0.0


def find_neutral(motion: Motion, rate: float) -> tuple[int, int]:
    """Return first and last row of the second in which the face is stillest.

    Between two that are equally still, the one nearer to the median face wins.
    """
    (stillest,) = still_seconds(motion, rate, 1)
    return stillest.rows


def still_seconds(motion: Motion, rate: float, count: int) -> list[Second]:
    """Return up to ``count`` seconds in which the face is still, the stillest first, one at least.

    None overlaps another. The unrest counts how far the face is from the median one, too.
    """
    frames = len(motion.places)
    window = int(np.clip(round(NEUTRAL.seconds * rate) if rate > 0 else 1, 1, frames))
    seen = np.isfinite(motion.places[..., 0])
    change = np.nan_to_num(motion.places - motion.middle)
    times = _sums(seen.astype(float), window)
    count_seen = np.maximum(times, 1.0)
    usual = times > window / 2
    mean = _sums(change, window) / count_seen[..., None]
    stirring = _sums((change**2).sum(axis=2), window) / count_seen - (mean**2).sum(axis=2)
    away = np.linalg.norm(mean, axis=2)
    known = np.maximum(usual.sum(axis=1), 1)
    cost = np.sqrt((np.maximum(stirring, 0.0) * usual).sum(axis=1) / known)
    cost += NEUTRAL.away * (away * usual).sum(axis=1) / known
    cost[known < NEUTRAL.seen * known.max()] = np.inf
    found: list[Second] = []
    for first in np.argsort(cost, kind="stable").tolist():
        if found and not np.isfinite(cost[first]):
            break
        if all(abs(first - each.rows[0]) >= window for each in found):
            found.append(Second((first, first + window - 1), float(cost[first])))
            if len(found) == count:
                break
    return found


def _sums(values: Floats, window: int) -> Floats:
    """Return sums over ``window`` frames, for every frame that has so many from it on."""
    total = np.cumsum(np.concatenate([np.zeros((1, *values.shape[1:])), values]), axis=0)
    return np.asarray(total[window:] - total[:-window])


# Takes that no face makes: all markers on a line or in a plane, or none that ever moves.


@dataclass(frozen=True)
class ExtentOptions:
    """Limits of what is a face."""

    line: float = 0.05  # of markers' extent along a line: their second extent; four on a brow 0.5
    plane: float = 0.01  # the same of the third one ...
    least: int = 6  # ... of so many markers; faces have 0.2
    far: float = 5.0  # times the usual distance from the middle: a marker is thrown, and left out
    still_mm: float = 0.3  # no marker goes farther from its middle place: nothing moves
    usual: float = 0.98  # quantile of its frames in that


SHAPE = ExtentOptions()


def refuse_flat(file: str, points: Floats) -> None:
    """Raise :class:`InputError` ``markers.flat`` for markers (k, 3) on a line or in a plane."""
    seen = points[np.isfinite(points[:, 0])]
    if not len(seen):
        return
    away = np.linalg.norm(seen - np.median(seen, axis=0), axis=1)
    seen = seen[away <= SHAPE.far * np.median(away)]  # a thrown one makes a line of any
    if len(seen) < 3:
        return
    extents = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    longest = max(float(extents[0]), 1e-12)
    is_line = extents[1] < SHAPE.line * longest
    if is_line or (len(seen) >= SHAPE.least and extents[2] < SHAPE.plane * longest):
        where = "on a line" if is_line else "in a plane"
        message = f"the {len(seen)} markers of {file} lie {where}: they are of no face in space"
        raise InputError("markers.flat", message, file=file, found=len(seen))


def is_motionless(motion: Motion) -> bool:
    """Tell whether no marker moves against the others, in more than a frame."""
    off = np.linalg.norm(motion.places - motion.middle, axis=2)
    off = off[:, np.isfinite(off).any(axis=0)]
    if len(off) < 2 or not off.shape[1]:
        return False
    return bool((np.nanquantile(off, SHAPE.usual, axis=0) <= SHAPE.still_mm).all())


# Swaps of two labels, from the frame in which they cross to the one in which they cross back. In a
# frame in which two labels are exchanged each marker leaps to where the other was, which no skin
# does. So a swap is found whatever the face does meanwhile, and however long it lasts.


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
    found = []
    taken = np.zeros(leaps.shape, bool)
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
    last = np.concatenate([np.full((1, seen.shape[1]), -1), last_true(seen)[:-1]])
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
    here = list(pair)
    there = list(pair[::-1])
    own = np.linalg.norm(places[near][:, here] - expected[near][:, here], axis=2)
    crossed = np.linalg.norm(places[near][:, here] - expected[near][:, there], axis=2)
    gain = own - crossed
    gain = gain[np.isfinite(gain)]
    return bool(len(gain) and np.median(gain) > 0.0)
