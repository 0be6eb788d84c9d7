"""Findings about the seconds that are taken for rest, in which markers are bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from solver.errors import MOST_NAMES, Severity, quote, quote_names
from solver.scans.markers.face_take import LocatedTake
from solver.scans.markers.findings import LIMITS, CheckLimits, MarkerCheck, add, count_words
from solver.scans.markers.marker_set import MarkerSet
from solver.scans.markers.motion import find_neutral
from solver.scans.markers.mouth import lips_apart, named_places
from solver.scans.markers.rest import REST, Rest
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
    shown = elsewhere[: LIMITS.named]
    named = [f"{quote(each['label'])} by {each['mm']:.1f} mm" for each in shown]
    (first, last), (one, other) = spans
    message = (
        f"The face is still in frames {first} to {last}, taken for rest, and held about as long "
        f"as in frames {one} to {other}, where markers lie elsewhere: {', '.join(named)}."
    )
    figures = {"label": elsewhere[0]["label"], "found": elsewhere[0]["mm"]}
    return {"message": message, "frames": spans, "elsewhere": elsewhere[:MOST_NAMES], **figures}


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
