"""Findings about a take of markers, each with a stable code, a plain sentence and advice.

Every code has one advice, in ``scans/advice.csv``; frames are named as the file counts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from solver.errors import MOST_NAMES, Finding, Severity, advise, count_words, quote, quote_names
from solver.registration.locate import nearest_axis
from solver.registration.units import ScanUnit
from solver.scans import read_advice
from solver.scans.markers.places.face_take import LocatedTake
from solver.scans.markers.places.locate import Located, LocateOptions, fit_most
from solver.scans.markers.places.marker_set import MarkerSet
from solver.scans.markers.readers.names import LOWER, Named
from solver.scans.markers.readers.raw_take import ADVICE as READING
from solver.scans.markers.signal.faults import WRONG, Span
from solver.scans.markers.signal.motion import find_neutral
from solver.scans.markers.signal.rest import RestOptions, compare_rests
from solver.surface import Floats

ADVICE = READING | read_advice("markers")
# Of what an actor's take is refused for: that it is an actor's is known.
ACTOR_ADVICE = {
    "markers.other_person": "Bind the take again with --actor, or name a frame at rest: --neutral."
}


@dataclass(frozen=True)
class CheckLimits:
    """Beyond these a take has a finding; lengths in mm."""

    wrong: float = 0.3  # of the markers' time: the take is bad
    seldom: float = 0.01  # of a label's time: outliers and ghosts are notes
    long_missing: float = 0.2  # of a label's time
    gone: float = 0.5  # s without any marker
    at_rest: float = 0.8  # of the markers are seen in frames at rest
    unrest: float = 1.0  # mm that most markers move in them, root mean square
    slow: float = 20.0  # frames a second; with fewer nothing sudden can be seen
    repeated: float = 0.05  # of the frames
    person: float = 3.0  # rms off the rig's skin, or off the places of a marker set
    open_mouth: float = 5.0  # rms of the jaw's markers, when the others fit
    lips_apart: float = 6.0  # more than at the places of a marker set: the mouth is open
    named_lips_apart: float = 12.0  # the same by names, which are less sure
    wide_open: float = 20.0  # the same of lips, or of the jaw's markers: it is no rest at all
    misplaced: float = 4.0  # off the place in the set, when the others fit
    fills: float = 4.0  # an unlabelled track so near to where a missing marker is expected
    share_filled: float = 0.5  # of a track's frames
    spans: int = 20  # of a finding that are listed
    named: int = RestOptions.named  # labels in a sentence
    labels: int = 12  # with a finding of their own; the others are counted


LIMITS = CheckLimits()


@dataclass
class MarkerCheck:
    """The findings of a check, its figures, and what its picture shows."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    labels: list[dict[str, Any]] = field(default_factory=list)  # a row for each
    located: LocatedTake | None = None  # the face's markers
    bound: MarkerSet | None = None  # proposed, if there is a rig


def add(check: MarkerCheck, code: str, severity: Severity, message: str, **figures: Any) -> None:
    """Add a finding with the advice that belongs to its code."""
    check.findings.append(advise(ADVICE, code, severity, message, **figures))


# Single labels.


FAULT_WORDS = {
    "frozen": "repeats its last place",
    "filled": "runs along a curve that a program has drawn",
    "missing": "is missing",
    "swapped": "is swapped with",
    "relabelled": "lies where another is expected:",
    "outlier": "is thrown off",
    "ghost": "is another thing between two gaps",
}


def report_faults(check: MarkerCheck, located: LocatedTake) -> None:
    """Add a finding for every label and fault, and what holds for all."""
    faults = located.faults
    labels = located.face.labels
    take = located.face.take
    rate = located.face.rate
    if faults.halted > LIMITS.repeated:
        message = f"{faults.halted:.0%} of the frames repeat the one before."
        add(check, "markers.repeated", "warning", message, found=round(faults.halted, 3))
    for group in faults.doubles:
        names = quote_names([labels[each] for each in group])
        *others, last = names if len(group) <= LIMITS.named else [*names[: LIMITS.named], "others"]
        message = f"{', '.join(others)} and {last} are one marker."
        add(check, "markers.double", "warning", message, label=labels[group[0]], labels=names)
    gone = faults.blanks(round(LIMITS.gone * rate))
    if gone:
        spans = [[take.numbers[first], take.numbers[last]] for first, last in gone]
        longest = max(last - first + 1 for first, last in gone) / rate
        number = count_words(len(gone), "span", "spans")
        message = f"No marker is seen in {number}, up to {longest:.1f} s."
        add(check, "markers.gone", "warning", message, frames=spans[: LIMITS.spans])
    for marker, span in sorted(faults.moved.items()):
        frame = take.numbers[span.first]
        message = f"{quote(labels[marker])} sits {span.mm:.1f} mm elsewhere from frame {frame} on."
        figures = {"label": labels[marker], "frame": frame, "found": round(span.mm, 1)}
        add(check, "markers.moved", "warning", message, **figures)
    for fault in FAULT_WORDS:
        _report_fault(check, located, fault, gone)
    frames = len(take)
    wrong = faults.share(*WRONG)
    missing = faults.share("missing")
    check.figures |= {"wrong": round(wrong, 4), "missing": round(missing, 4)}
    if wrong > LIMITS.wrong:
        message = f"{wrong:.0%} of the markers' time in {frames} frames is wrong."
        add(check, "markers.wrong", "error", message, found=round(wrong, 3), expected=LIMITS.wrong)


def _report_fault(
    check: MarkerCheck, located: LocatedTake, fault: str, gone: Sequence[tuple[int, int]]
) -> None:
    """Add a finding for each label with a fault, the worst first; the last counts the others."""
    found = []
    labels = located.face.labels
    frames = len(located.face.take)
    for marker, others in located.faults.by_marker(fault).items():
        for other, spans in others.items():
            own = [span for span in spans if (span.first, span.last) not in gone]
            twice = fault == "swapped" and other is not None and other < marker
            if own and not twice:
                found.append((sum(span.frames for span in own) / frames, marker, other, own))
    found.sort(key=lambda each: -each[0])
    least = LIMITS.long_missing if fault == "missing" else 0.0
    shown = [each for each in found[: LIMITS.labels] if each[0] >= least]
    for share, marker, other, spans in shown:
        _report_spans(check, located, fault, (marker, other), spans, share)
    rest = found[len(shown) :]
    if rest:
        names = quote_names([labels[each[1]] for each in rest])
        which = "label has gaps", "labels have gaps"
        if fault != "missing":
            which = f"more label {FAULT_WORDS[fault]}", f"more labels: {FAULT_WORDS[fault]}"
        worst = f"at most {rest[0][0]:.1%} of the time, {names[0]}"
        severity: Severity = "warning" if fault in ("swapped", "relabelled") else "info"
        message = f"{count_words(len(rest), *which)}, {worst}."
        add(check, f"markers.{fault}", severity, message, labels=names)


def _report_spans(
    check: MarkerCheck,
    located: LocatedTake,
    fault: str,
    pair: tuple[int, int | None],
    spans: list[Span],
    share: float,
) -> None:
    """Add the finding of one label, and of the ``pair``'s other where it takes that one's place."""
    (marker, other), labels, numbers = pair, located.face.labels, located.face.take.numbers
    count = sum(span.frames for span in spans)
    severity: Severity = "info" if fault == "filled" else "warning"
    if fault in ("outlier", "ghost", "frozen") and share < LIMITS.seldom:
        severity = "info"
    listed = [[numbers[span.first], numbers[span.last]] for span in spans]
    what = FAULT_WORDS[fault] if other is None else f"{FAULT_WORDS[fault]} {quote(labels[other])}"
    where = f"frames {listed[0][0]} to {listed[0][1]}" if count > 1 else f"frame {listed[0][0]}"
    if len(spans) > 1:
        where = f"{len(spans)} spans, {count} frames, the first {listed[0][0]} to {listed[0][1]}"
    most = max(span.mm for span in spans)
    off = f" by up to {most:.0f} mm" if fault in ("outlier", "ghost") else ""
    figures: dict[str, Any] = {"label": labels[marker], "frames": listed[: LIMITS.spans]}
    if other is not None:
        figures["other"] = labels[other]
    message = f"{quote(labels[marker])} {what}{off}: {where}."
    add(check, f"markers.{fault}", severity, message, share=round(share, 4), **figures)


def label_rows(located: LocatedTake) -> list[dict[str, Any]]:
    """Return a table's row for each label: in how many frames it is seen, and has which fault."""
    rows = []
    for number, label in enumerate(located.face.labels):
        frames = {
            fault: sum(span.frames for span in located.faults.of(fault) if span.marker == number)
            for fault in (*FAULT_WORDS, "moved")
        }
        seen = len(located.face.take) - frames["missing"]
        rows.append({"label": label, "seen": seen, **frames})
    return rows


def report_unlabelled(check: MarkerCheck, located: LocatedTake) -> None:
    """Add which unlabelled tracks lie where a missing marker is expected."""
    faults = located.faults
    take = located.face.take
    if not take.unlabelled_names:
        return
    motion = faults.motion
    missing = ~np.isfinite(faults.motion.places[..., 0])
    fits = []
    for track, name in enumerate(take.unlabelled_names):
        frames = np.flatnonzero(np.isfinite(take.unlabelled[:, track, 0]))
        if not len(frames):
            continue
        points = located.face.mm * take.unlabelled[frames, track]
        placed = np.einsum("fij,fj->fi", motion.rotations[frames], points) + motion.shifts[frames]
        away = np.linalg.norm(motion.expected[frames] - placed[:, None], axis=2)
        near = (missing[frames] & (away < LIMITS.fills)).mean(axis=0)
        best = int(np.argmax(near))
        if near[best] > LIMITS.share_filled:
            label = located.face.labels[best]
            spans = [[take.numbers[frames[0]], take.numbers[frames[-1]]]]
            fits.append({"track": quote(name), "label": quote(label), "frames": spans})
    message = f"{count_words(len(take.unlabelled_names), 'track has', 'tracks have')} no label"
    if fits:
        shown = ", ".join(f"{each['track']} is {each['label']}" for each in fits[:3])
        message += f"; {count_words(len(fits), 'fills', 'fill')} gaps of a marker: {shown}"
    add(check, "markers.unlabelled", "info", f"{message}.", tracks=fits[:MOST_NAMES])


def report_location(check: MarkerCheck, located: LocatedTake, pose: Located) -> None:
    """Add unit and axes, and what is mirrored or exchanged."""
    take = located.face.take
    labels = located.face.labels
    rotation = pose.session.rotation
    read = ScanUnit(take.unit_mm, "assumed")
    unit = ScanUnit(take.unit_mm * pose.unit.mm_per_unit, pose.unit.source)  # of the file
    up = nearest_axis(rotation[1])
    forward = nearest_axis(rotation[2])
    check.figures |= {
        "unit": unit.name,
        "mm_per_unit": unit.mm_per_unit,
        "up": up,
        "forward": forward,
        "left_handed": pose.mirrored,
        "by_names": pose.by_names,
        "height_mm": round(pose.height_mm, 1),
        "off_skin_mm": round(pose.miss(), 2),
    }
    if unit.source != "assumed":
        times = pose.unit.mm_per_unit
        off = f"{times:.3g} times too small" if times > 1 else f"{1 / times:.3g} times too large"
        message = f"Read {read.words}, the face would be {off}; it is read {unit.words}."
        figures = {"expected": read.mm_per_unit, "found": unit.mm_per_unit, "unit": unit.name}
        add(check, "markers.unit", "warning", message, **figures)
    if pose.mirrored:
        message = f"{take.file} is mirrored: its axes are left-handed."
        add(check, "markers.mirrored", "warning", message)
    if pose.sides_exchanged:
        message = "Labels of the left lie on the right, and those of the right on the left."
        add(check, "markers.sides", "warning", message)
    if (up, forward) != ("y", "z"):
        message = f"The face looks along {forward}, its top is at {up}."
        add(check, "markers.axes", "info", message, up=up, forward=forward)
    row = sum(located.neutral) // 2
    swaps = [each for each in located.faults.of("swapped") if each.first <= row <= each.last]
    for a, b in pose.exchanged:
        if not any((each.marker, each.other) == (a, b) for each in swaps):  # reported already
            report_exchanged(check, labels[a], labels[b])


def report_exchanged(check: MarkerCheck, first: str, second: str) -> None:
    """Add that two labels have each other's marker all the time."""
    message = f"{quote(first)} and {quote(second)} lie in each other's place in the whole take."
    add(check, "markers.exchanged", "warning", message, label=first, other=second)


def report_rest(check: MarkerCheck, located: LocatedTake, *, is_given: bool) -> None:
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
    if len(hidden) > (1.0 - LIMITS.at_rest) * seen.shape[1]:
        names = quote_names([located.face.labels[each] for each in hidden.tolist()])
        message = f"{len(hidden)} of {seen.shape[1]} markers are not seen in {frames}.{stillest}"
        add(check, "markers.neutral", "warning", message, labels=names, **figures)
        return
    spread = np.sqrt(np.nanvar(places[:, seen.any(axis=0)], axis=0).sum(axis=1))
    unrest = float(np.median(spread))
    if unrest > LIMITS.unrest:
        which = "these" if is_given else "taken for rest"
        message = f"The face moves in {frames}, {which}, by {unrest:.1f} mm.{stillest}"
        add(check, "markers.neutral", "warning", message, found=round(unrest, 2), **figures)


def report_mouth(check: MarkerCheck, located: LocatedTake, places: Floats | None) -> None:
    """Add that the mouth is open at rest: by ``places`` (n, 3) of the markers with the lips closed.

    Without them by those that the labels name, which are less sure.
    """
    pose = located.pose
    names = located.face.names
    if pose is None or (places is None and (not pose.by_names or pose.sides_exchanged)):
        return
    limit = LIMITS.lips_apart if places is not None else LIMITS.named_lips_apart
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
        severity: Severity = "error" if apart > LIMITS.wide_open else "warning"
        add(check, "markers.neutral", severity, message, **figures)


def report_off_skin(check: MarkerCheck, located: LocatedTake, markers: MarkerSet) -> None:
    """Add which labels of the face are left out of a set: they lie too far off the skin."""
    ignored = {each.label for each in markers.markers if each.part == "ignore"}
    face = zip(located.face.labels, located.face.names, strict=True)
    off = [label for label, name in face if label in ignored and name and name.part == "face"]
    if off:
        names = quote_names(off)
        one = "label of the face lies"
        many = "labels of the face lie"
        where = "too far off the skin, and"
        what = count_words(len(off), f"{one} {where} is", f"{many} {where} are")
        message = f"{what} left out: {', '.join(names)}."
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
