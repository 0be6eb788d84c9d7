"""Faults of single markers of a take: frozen, filled, swapped, moved, thrown, missing.

A marker is wrong where it is far from where most others put it (``motion.py``) and came or went
there at once, as no skin does; two are swapped where each lies where the other is expected, or from
the frame in which they cross on, until they cross back (:func:`.find_swaps`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from solver.scans.markers.signal.motion import (
    Mask,
    Motion,
    Swap,
    exchange,
    find_swaps,
    median_of_seen,
    take_apart,
)
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class FaultOptions:
    """Limits of faults; lengths in mm, times in s."""

    frozen: float = 0.08  # a place repeated for so long ...
    least_frozen: int = 4  # ... and in so many frames is no measurement
    stirred: float = 0.05  # that the others moved by meanwhile: coarse decimals repeat, too
    halted: float = 0.9  # of the markers repeat: it is the file that repeats a frame
    filled: float = 0.1  # a cubic for so long is drawn by a program ...
    least_filled: int = 6  # ... in so many frames
    cubic: float = 0.03  # fourth differences by those of the other markers: no noise
    wrong: float = 3.5  # off what is expected, or ...
    spread: float = 5.0  # ... so many times what is usual for the marker
    speed: float = 180.0  # mm/s against what is expected; lids reach 160 ...
    least_jump: float = 2.5  # ... and in one frame
    neighbours: int = 6  # that a marker may be swapped with ...
    apart: tuple[float, float] = (4.0, 70.0)  # ... if they lie so far from it
    near: float = 0.4  # of the way to another's place: it lies there ...
    less_near: float = 0.8  # the same, where exchanging two gains what it does of exact places
    reach: float = 6.0  # ... if it is so near to it
    ghost: float = 8.0  # off, between two gaps, is another thing
    block: float = 0.25  # whose median shows where a marker sits
    moved: float = 3.0  # a marker that stays so far off has moved ...
    settled: float = 1.0  # ... if it was in either place for so long ...
    sharp: float = 0.6  # ... most of the way went at once ...
    steady: float = 0.4  # ... and less of it is what else it does
    bridged: int = 2  # good frames between two bad ones are bad
    double: float = 1.0  # two labels so near each other have one marker

    def jump(self, rate: float) -> float:
        """Return how far no marker of skin goes off what is expected in one frame."""
        return max(self.least_jump, self.speed / rate)


FAULT = FaultOptions()


@dataclass(frozen=True)
class Span:
    """Frames ``first`` to ``last``, from 0, in which something is wrong with a marker."""

    fault: str  # frozen, filled, swapped, relabelled, moved, outlier, ghost or missing
    marker: int
    first: int
    last: int
    other: int | None = None  # the marker whose place it takes
    mm: float = 0.0  # how far it is off, at most; moved: by how much

    @property
    def frames(self) -> int:
        """Return how many frames it lasts."""
        return self.last - self.first + 1


WRONG = ("frozen", "swapped", "relabelled", "outlier", "ghost")  # to be left out or put right


@dataclass
class Faults:
    """Faults of the markers of a take of f frames and k labels."""

    spans: list[Span]
    motion: Motion
    usable: Mask  # (f, k) points that are seen and not wrong
    dead: Ints  # markers that are never seen
    doubles: list[list[int]] = field(default_factory=list)  # labels that are one marker
    halted: float = 0.0  # share of frames that repeat the one before
    moved: dict[int, Span] = field(default_factory=dict)

    def of(self, *faults: str) -> list[Span]:
        """Return the spans of some faults."""
        return [span for span in self.spans if span.fault in faults]

    def share(self, *faults: str) -> float:
        """Return the share of the living markers' time that has any of ``faults``."""
        frames, count = self.usable.shape
        living = frames * (count - len(self.dead))
        return float(sum(span.frames for span in self.of(*faults)) / max(living, 1))

    def by_marker(self, fault: str) -> dict[int, dict[int | None, list[Span]]]:
        """Return the spans of a fault by marker, then by the marker whose place it takes."""
        found: dict[int, dict[int | None, list[Span]]] = {}
        for span in self.of(fault):
            found.setdefault(span.marker, {}).setdefault(span.other, []).append(span)
        return found

    @property
    def unmeasured(self) -> Mask:
        """Return which points (f, k) were not measured: frozen or drawn."""
        found = np.zeros(self.usable.shape, bool)
        for span in self.of("frozen", "filled"):
            found[span.first : span.last + 1, span.marker] = True
        return found

    def put_right(self, positions: Floats) -> tuple[Floats, Mask]:
        """Return ``positions`` (f, k, 3) with swapped labels exchanged, and which (f, k) were.

        What was not measured is NaN.
        """
        measured = np.where(self.unmeasured[..., None], np.nan, positions)
        right = measured.copy()
        exchanged = np.zeros(positions.shape[:2], bool)
        for span in self.of("swapped"):
            rows = slice(span.first, span.last + 1)
            right[rows, span.marker] = measured[rows, span.other]
            exchanged[rows, span.marker] = True
        return right, exchanged

    def blanks(self, least: int) -> list[tuple[int, int]]:
        """Return first and last frames of spans of ``least`` frames in which nothing is seen."""
        seen = np.asarray(np.isfinite(self.motion.places[..., 0]).any(axis=1))
        return [run for run in runs(~seen) if run[1] - run[0] + 1 >= least]


def find_faults(positions: Floats, rate: float) -> Faults:
    """Find what is wrong with markers (f, k, 3) in mm, NaN where missing."""
    seen = np.isfinite(positions[..., 0])
    spans: list[Span] = []
    frozen, halted = _find_frozen(positions, rate, spans)
    measured = np.where(frozen[..., None], np.nan, positions)
    _find_filled(measured, rate, spans)
    motion = take_apart(measured, rate)
    pairs = list(_neighbours(motion.middle))
    leap = FAULT.jump(rate)
    swaps = find_swaps(motion.places, motion.expected, pairs, leap, rate)
    if swaps:  # they bend what is expected of all markers
        motion = take_apart(exchange(measured, swaps), rate)
        motion = replace(motion, places=exchange(motion.places, swaps))
    residuals = motion.residuals
    taken = _find_exchanged(motion, residuals, rate, swaps, spans)
    residuals = np.where(taken[..., None], np.nan, residuals)
    moved = _find_moved(residuals, rate)
    spans += moved.values()
    thrown = _find_thrown(residuals, rate, spans)
    for marker in np.flatnonzero(seen.any(axis=0)):
        spans += (Span("missing", int(marker), *run) for run in runs(~seen[:, marker]))
    usable = seen & ~frozen & ~taken & ~thrown
    dead = np.flatnonzero(~seen.any(axis=0))
    doubles = _find_doubles(positions)
    spans.sort(key=lambda span: (span.marker, span.first))
    return Faults(spans, motion, usable, dead, doubles, halted, moved)


def runs(mask: Mask, bridged: int = 0) -> Iterator[tuple[int, int]]:
    """Yield first and last numbers of the runs of what is true, over gaps of ``bridged``."""
    true = np.flatnonzero(mask)
    if len(true):
        breaks = np.flatnonzero(np.diff(true) > 1 + bridged)
        starts = np.append(true[0], true[breaks + 1])
        ends = np.append(true[breaks], true[-1])
        yield from zip(starts.tolist(), ends.tolist(), strict=True)


def _find_frozen(positions: Floats, rate: float, spans: list[Span]) -> tuple[Mask, float]:
    """Return which points (f, k) repeat the marker's last value, and how many frames halt."""
    seen = np.isfinite(positions[..., 0])
    same = np.zeros(seen.shape, bool)
    same[1:] = (positions[1:] == positions[:-1]).all(axis=2)
    halts = same.sum(axis=1) >= FAULT.halted * np.maximum(seen.sum(axis=1), 1)
    frozen = np.zeros(seen.shape, bool)
    least = max(FAULT.least_frozen, round(FAULT.frozen * rate))
    changes = same & ~halts[:, None]
    for marker in np.flatnonzero(changes.sum(axis=0) >= least):
        for first, last in runs(same[:, marker]):
            way = np.linalg.norm(positions[last] - positions[first - 1], axis=1)
            stirred = np.median(way[np.isfinite(way)]) > FAULT.stirred
            if changes[first : last + 1, marker].sum() >= least and stirred:
                frozen[first : last + 1, marker] = True
                spans.append(Span("frozen", int(marker), first, last))
    return frozen, float(halts.mean())


def _find_filled(positions: Floats, rate: float, spans: list[Span]) -> None:
    """Find where markers run along a cubic, without the noise of the others in those frames."""
    least = max(FAULT.least_filled, round(FAULT.filled * rate))
    if len(positions) < 2 * least + 4 or positions.shape[1] < 4:
        return
    bend = np.abs(np.diff(positions, n=4, axis=0)).max(axis=2)
    usual = np.nan_to_num(median_of_seen(bend.T))
    floor = 10 * _resolution(positions)  # 16 halves of a step, which rarely meet
    ratio = np.where((usual > 2 * floor)[:, None], bend / (usual[:, None] + 1e-12), np.nan)
    by_marker = median_of_seen(ratio)
    limit = FAULT.cubic * usual[:, None] * np.nan_to_num(by_marker, nan=1.0) + floor
    smooth = (bend < limit) & (usual > 4 * floor)[:, None]
    for marker in np.flatnonzero(smooth.sum(axis=0) >= least):
        for first, last in runs(smooth[:, marker]):
            if last - first + 1 >= least:
                spans.append(Span("filled", int(marker), first + 1, last + 3))


def _resolution(positions: Floats) -> float:
    """Return the least step between the coordinates in a file, of its decimals or its floats."""
    some = positions[:: max(1, len(positions) // 200)].ravel()
    known = some[np.isfinite(some)]
    steps = np.diff(np.unique(np.round(known, 7)))
    if not len(steps):
        return 0.0
    return float(max(steps.min(), np.finfo(np.float32).eps * np.abs(known).max()))


def _find_exchanged(
    motion: Motion, residuals: Floats, rate: float, crossed: Sequence[Swap], spans: list[Span]
) -> Mask:
    """Return which points (f, k) lie where another marker is expected that does not lie there.

    Labels that have ``crossed`` are swapped.
    """
    off = np.linalg.norm(residuals, axis=2)
    missing = np.isnan(off)
    bad = np.nan_to_num(off) > FAULT.wrong
    taken = np.zeros(bad.shape, bool)
    found: dict[tuple[int, int, str], list[Ints]] = {}

    def add_swap(a: int, b: int, rows: Ints) -> None:
        taken[rows, a] = taken[rows, b] = True
        found.setdefault((a, b, "swapped"), []).append(rows)
        found.setdefault((b, a, "swapped"), []).append(rows)

    def add_swaps(where: Mask, lies_at: Ints | None = None) -> None:
        for a, b, rows in _swaps(motion, off, where, lies_at):
            add_swap(a, b, rows)

    for each in crossed:
        add_swap(each.a, each.b, each.rows)
    add_swaps(bad & ~taken)
    frames, markers = np.nonzero(bad & ~taken)
    free = (missing | bad) & ~taken
    others, near = _nearest_expected(motion, frames, markers, free)
    there = near < np.minimum(FAULT.near * off[frames, markers], FAULT.reach)
    lies_at = np.full(bad.shape, -1)
    lies_at[frames[there], markers[there]] = others[there]
    add_swaps(bad & ~taken, lies_at)
    for a, b in {*zip(markers[there].tolist(), others[there].tolist(), strict=True)}:
        here = np.flatnonzero((lies_at[:, a] == b) & ~taken[:, a])
        taken[here, a] = True
        found.setdefault((a, b, "relabelled"), []).append(here)
    for (a, b, fault), lists in found.items():
        mask = np.zeros(len(off), bool)
        mask[np.concatenate(lists)] = True
        for first, last in runs(mask, FAULT.bridged):
            came, went = _jumps(residuals[:, a], first, last)
            is_sudden = bool(np.fmax(came, went) > FAULT.jump(rate)) or np.isnan([came, went]).all()
            if fault == "relabelled" and not is_sudden:
                taken[first : last + 1, a] = False
                continue
            mm = float(np.nanmax(off[first : last + 1, a]))
            spans.append(Span(fault, a, first, last, b, mm))
    return taken


def _swaps(
    motion: Motion, off: Floats, bad: Mask, lies_at: Ints | None
) -> Iterator[tuple[int, int, Ints]]:
    """Yield pairs of markers with the frames in which each lies where the other is expected.

    With ``lies_at`` (f, k), the marker at whose place one lies or -1, they may lie off there, if
    exchanging them gains what it does of exact places and neither lies at a third one's: of three
    in a circle two look swapped as well.
    """
    for a, b in _neighbours(motion.middle):
        frames = np.flatnonzero(bad[:, a] & bad[:, b])
        expected = motion.expected[frames]
        places = motion.places[frames]
        crossed = [
            np.linalg.norm(places[:, here] - expected[:, there], axis=1)
            for here, there in ((a, b), (b, a))
        ]
        apart = np.linalg.norm(expected[:, a] - expected[:, b], axis=1)
        gain = off[frames, a] ** 2 + off[frames, b] ** 2 - crossed[0] ** 2 - crossed[1] ** 2
        worse = np.maximum(*crossed)
        close = worse < np.maximum(FAULT.near * apart, FAULT.wrong)
        if lies_at is not None:
            close = (worse < FAULT.less_near * apart) & (gain > 2.0 * apart**2)
            for here, there in ((a, b), (b, a)):
                close &= np.isin(lies_at[frames, here], (-1, there))
        yield a, b, frames[(gain > apart**2) & close & (apart > FAULT.apart[0])]


def _neighbours(middle: Floats) -> Iterator[tuple[int, int]]:
    """Yield pairs of markers that lie next to each other."""
    apart = np.linalg.norm(middle[:, None] - middle[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    apart = np.where(np.isnan(apart) | (apart < FAULT.apart[0]), np.inf, apart)
    near = np.argsort(apart, axis=1)[:, : FAULT.neighbours]
    pairs = {
        (min(a, b), max(a, b))
        for a, row in enumerate(near.tolist())
        for b in row
        if apart[a, b] < FAULT.apart[1]
    }
    yield from sorted(pairs)


def _nearest_expected(
    motion: Motion, frames: Ints, markers: Ints, free: Mask, batch: int = 20_000
) -> tuple[Ints, Floats]:
    """Return whose place is nearest to each bad point, of markers that are not there, and how."""
    others = np.zeros(len(frames), np.int64)
    near = np.full(len(frames), np.inf)
    known = np.isfinite(motion.middle[:, 0])
    for start in range(0, len(frames), batch):
        part = slice(start, start + batch)
        f = frames[part]
        m = markers[part]
        away = np.linalg.norm(motion.places[f, m][:, None] - motion.expected[f], axis=2)
        away[~(free[f] & known) | np.isnan(away)] = np.inf
        away[np.arange(len(f)), m] = np.inf
        others[part] = np.argmin(away, axis=1)
        near[part] = away[np.arange(len(f)), others[part]]
    return others, near


def _find_moved(residuals: Floats, rate: float) -> dict[int, Span]:
    """Find markers that stay elsewhere from a frame on; takes it out of ``residuals``."""
    size = max(1, round(FAULT.block * rate))
    blocks = len(residuals) // size
    least = max(2, round(FAULT.settled / FAULT.block))
    found: dict[int, Span] = {}
    if blocks < 2 * least:
        return found
    cut = residuals[: blocks * size].reshape(blocks, size, *residuals.shape[1:])
    medians = median_of_seen(cut.swapaxes(0, 1))
    known = np.isfinite(medians[..., 0])
    for marker in range(residuals.shape[1]):
        there = np.flatnonzero(known[:, marker])
        if len(there) < 2 * least:
            continue
        way = medians[there, marker]
        split = _best_split(way, least)
        before = np.median(way[:split], axis=0)
        after = np.median(way[split:], axis=0)
        step = after - before
        length = float(np.linalg.norm(step))
        left = way[split - 2 : split]
        right = way[split : split + 2]
        at_once = np.median(right, axis=0) - np.median(left, axis=0)
        levels = np.where(np.arange(len(way))[:, None] < split, before, after)
        else_ = float(np.quantile(np.linalg.norm(way - levels, axis=1), 0.8))
        is_sharp = at_once @ step > FAULT.sharp * length**2
        if length < FAULT.moved or not is_sharp or else_ > FAULT.steady * length:
            continue
        low = int(there[split - 1]) * size
        high = int((there[split] + 1) * size)
        first = low + _largest_jump(residuals[low:high, marker])
        residuals[:first, marker] -= before
        residuals[first:, marker] -= after
        found[marker] = Span("moved", marker, first, len(residuals) - 1, None, length)
    return found


def _best_split(way: Floats, least: int) -> int:
    """Return where places (n, 3) are best cut in two, each about a mean."""
    count = np.arange(1, len(way))
    sums = np.cumsum(way, axis=0)
    before = sums[:-1] / count[:, None]
    after = (sums[-1] - sums[:-1]) / (len(way) - count)[:, None]
    gain = count * (len(way) - count) * ((before - after) ** 2).sum(axis=1)
    return least + int(np.argmax(gain[least - 1 : len(way) - least]))


def _largest_jump(way: Floats) -> int:
    """Return the frame that is farthest from the one seen before it."""
    seen = np.flatnonzero(np.isfinite(way[:, 0]))
    jumps = np.linalg.norm(np.diff(way[seen], axis=0), axis=1)
    return int(seen[int(np.argmax(jumps)) + 1]) if len(jumps) else 0


def _find_thrown(residuals: Floats, rate: float, spans: list[Span]) -> Mask:
    """Return which points (f, k) are far off and came or went there at once, or between gaps."""
    off = np.linalg.norm(residuals, axis=2)
    thrown = np.zeros(off.shape, bool)
    for marker in np.flatnonzero((np.nan_to_num(off) > FAULT.wrong).any(axis=0)):
        here = off[:, marker]
        usual = float(np.nanmedian(here))
        bad = np.nan_to_num(here) > max(FAULT.wrong, FAULT.spread * usual)
        for first, last in runs(bad, FAULT.bridged):
            came, went = _jumps(residuals[:, marker], first, last)
            most = float(np.nanmax(here[first : last + 1]))
            is_outlier = bool(np.fmax(came, went) > FAULT.jump(rate))
            is_ghost = np.isnan([came, went]).all() and most > FAULT.ghost
            if is_outlier or is_ghost:
                thrown[first : last + 1, marker] = np.isfinite(here[first : last + 1])
                fault = "outlier" if is_outlier else "ghost"
                spans.append(Span(fault, int(marker), first, last, None, most))
    return thrown


def _jumps(way: Floats, first: int, last: int) -> tuple[float, float]:
    """Return how far a marker is off its place a frame before and after; NaN at a gap."""
    around = np.full((2, 3), np.nan)
    if first > 0:
        around[0] = way[first - 1]
    if last + 1 < len(way):
        around[1] = way[last + 1]
    came, went = np.linalg.norm(way[[first, last]] - around, axis=1)
    return float(came), float(went)


def _find_doubles(positions: Floats) -> list[list[int]]:
    """Return groups of labels that lie in one place all the time."""
    some = positions[:: max(1, len(positions) // 50)]
    apart = np.array([np.linalg.norm(each[:, None] - each[None], axis=2) for each in some])
    known = np.isfinite(apart)
    near = (known & (apart < FAULT.double)).sum(axis=0)
    is_double = (near > 0.9 * known.sum(axis=0)) & (known.sum(axis=0) > 0)
    count, group = connected_components(is_double)
    groups = [np.flatnonzero(group == each).tolist() for each in range(count)]
    return [each for each in groups if len(each) > 1]
