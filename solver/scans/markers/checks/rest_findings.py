"""Findings about the seconds that are taken for rest, in which markers are bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from solver.errors import Severity, quote_names
from solver.scans.markers.checks.findings import LIMITS, CheckLimits, MarkerCheck, add, count_words
from solver.scans.markers.places.face_take import LocatedTake
from solver.scans.markers.places.locate import LocateOptions, fit_most
from solver.scans.markers.places.marker_set import MarkerSet
from solver.scans.markers.readers.names import LOWER, Named
from solver.scans.markers.signal.motion import find_neutral
from solver.scans.markers.signal.rest import compare_rests
from solver.surface import Floats


def report_rest(
    check: MarkerCheck, located: LocatedTake, *, is_given: bool, limits: CheckLimits = LIMITS
) -> None:
    """Add whether frames at rest show too few markers, move, or are one choice of several."""
    motion, (first, last) = located.faults.motion, located.neutral
    numbers = located.face.take.numbers
    places = motion.places[first : last + 1]
    seen = np.isfinite(places[..., 0])
    hidden = np.flatnonzero(~seen.any(axis=0))
    frames = f"frames {numbers[first]} to {numbers[last]}"
    figures: dict[str, Any] = {"frames": [numbers[first], numbers[last]]}
    stillest = ""
    if is_given:
        one, other = (numbers[row] for row in find_neutral(motion, located.face.rate))
        figures["stillest"] = [one, other]
        stillest = f" The stillest are {one} to {other}."
    elif located.rest is not None and located.rival is not None:
        compared = compare_rests(located.rest, located.rival, located.face.labels, numbers)
        add(check, "markers.unclear_rest", "warning", **compared)
    if len(hidden) > (1.0 - limits.at_rest) * seen.shape[1]:
        names = quote_names([located.face.labels[each] for each in hidden.tolist()])
        message = f"{len(hidden)} of {seen.shape[1]} markers are not seen in {frames}.{stillest}"
        add(check, "markers.neutral", "warning", message, labels=names, **figures)
        return
    spread = np.sqrt(np.nanvar(places[:, seen.any(axis=0)], axis=0).sum(axis=1))
    unrest = float(np.median(spread))
    if unrest > limits.unrest:
        which = "these" if is_given else "taken for rest"
        message = f"The face moves in {frames}, {which}, by {unrest:.1f} mm.{stillest}"
        add(check, "markers.neutral", "warning", message, found=round(unrest, 2), **figures)


def report_mouth(
    check: MarkerCheck, located: LocatedTake, places: Floats | None, limits: CheckLimits = LIMITS
) -> None:
    """Add that the mouth is open at rest: by ``places`` (n, 3) of the markers with the lips closed.

    Without them by those that the labels name, which are less sure.
    """
    pose, names = located.pose, located.face.names
    if pose is None or (places is None and (not pose.by_names or pose.sides_exchanged)):
        return
    limit = limits.lips_apart if places is not None else limits.named_lips_apart
    goal = named_places(names) if places is None else places
    apart = lips_apart(pose.session(located.points), names, goal)
    if apart > limit:
        numbers = located.face.take.numbers
        first, last = (numbers[row] for row in located.neutral)
        message = (
            f"In frames {first} to {last}, taken for rest, the mouth is open: the lips are about "
            f"{apart:.0f} mm farther apart than closed ones."
        )
        figures = {"frames": [first, last], "found": round(apart, 1), "expected": limit}
        severity: Severity = "error" if apart > limits.wide_open else "warning"
        add(check, "markers.neutral", severity, message, **figures)


def report_off_skin(check: MarkerCheck, located: LocatedTake, markers: MarkerSet) -> None:
    """Add which labels of the face are left out of a set: they lie too far off the skin."""
    ignored = {each.label for each in markers.markers if each.part == "ignore"}
    face = zip(located.face.labels, located.face.names, strict=True)
    off = [label for label, name in face if label in ignored and name and name.part == "face"]
    if off:
        names = quote_names(off)
        what = count_words(len(off), "label of the face lies", "labels of the face lie")
        message = f"{what} too far off the skin, and are left out: {', '.join(names)}."
        message = message if len(off) > 1 else message.replace("and are", "and is")
        add(check, "markers.off_skin", "warning", message, labels=names)


def lips_apart(
    placed: Floats, names: Sequence[Named | None], goal: Floats, least: int = LocateOptions.least
) -> float:
    """Return how much farther apart the lips are in ``placed`` (k, 3) than in ``goal`` (k, 3), mm.

    ``goal`` has the lips closed, y up; the size of the face is that of its markers above the lower
    lip. NaN if markers of both lips, or ``least`` others, are not known in both.
    """
    known = np.isfinite(placed[:, 0]) & np.isfinite(goal[:, 0])
    known &= np.array([each is not None and each.part == "face" for each in names], bool)
    regions = [None if each is None else each.region for each in names]
    is_upper = known & np.array([each == "upper_lip" for each in regions], bool)
    is_lower = known & np.array([each == "lower_lip" for each in regions], bool)
    still = known & np.array([each not in LOWER for each in regions], bool)
    if still.sum() < least or not is_upper.any() or not is_lower.any():
        return float("nan")
    motion, _ = fit_most(placed[still], goal[still])
    off = motion(placed)[:, 1] - goal[:, 1]
    return float(off[is_upper].mean() - off[is_lower].mean())


def named_places(names: Sequence[Named | None]) -> Floats:
    """Return the places (k, 3) on a middling face by names, NaN for those without one."""
    nowhere = (np.nan, np.nan, np.nan)
    return np.array([nowhere if each is None else each.place for each in names], float)
