"""Findings about a take of markers, each with a stable code, a plain sentence and advice.

Every code has one advice, here; frames are named as the file counts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from solver.errors import MOST_NAMES, Finding, Severity, advise, quote, quote_names
from solver.registration.locate import nearest_axis
from solver.registration.units import ScanUnit
from solver.scans.markers.places.face_take import LocatedTake
from solver.scans.markers.places.locate import Located
from solver.scans.markers.places.marker_set import MarkerSet
from solver.scans.markers.readers.raw_take import ADVICE as READING
from solver.scans.markers.signal.faults import WRONG, Span
from solver.scans.markers.signal.rest import RestOptions

WHERE = "on the brows, the cheeks, the lips' rims, the chin, and four on a headband"
ADVICE = {
    **READING,
    # the file
    "markers.axes": "Nothing to do: the take is turned.",
    "markers.repeated": "Export at the rate of the recording: repeated frames hold nothing new.",
    "markers.mirrored": "Export with right-handed axes; until then the take is mirrored back.",
    "markers.sides": "Left is the person's own left: exchange the sides of the labels.",
    "markers.outside": "Nothing to do: these labels are left out.",
    "markers.unlabelled": "Label these tracks as the message says, or go on: they are candidates.",
    "markers.reach": "Put the next marker there, if there is one to spare.",
    "markers.few": f"Put more markers on the face: {WHERE}.",
    # single labels
    "markers.dead": "Nothing to do: the label is left out.",
    "markers.double": "Leave one of these labels, and take the others out.",
    "markers.unlike_set": "Bind the take a second time if markers were added or renamed.",
    "markers.frozen": "Nothing to do: these frames count as missing.",
    "markers.filled": "Nothing to do, but gaps left open are filled better by the fit.",
    "markers.missing": "Nothing to do if they are short; else look for what hid the marker.",
    "markers.gone": "Nothing to do: these frames are predicted, and marked so.",
    "markers.swapped": "Exchange the two labels in these frames, or go on: the fit does.",
    "markers.relabelled": "Give the track the other label in these frames, or go on: the fit does.",
    "markers.exchanged": "Exchange the two labels in the whole take.",
    "markers.moved": "Nothing to do: the fit places it anew from then on. Bind later takes again.",
    "markers.outlier": "Nothing to do: the fit leaves these frames of the label out.",
    "markers.ghost": "Nothing to do: a reflection took the label, and is left out.",
    "markers.wrong": "Clean the take, or take it again: too much of it is wrong.",
    # the person
    "markers.neutral": "Name frames with a relaxed face, lips closed, or the expression they show.",
    "markers.unclear_rest": "Look at both, and name a frame with the face at rest: --neutral.",
    "markers.off_skin": "Name other frames at rest if the mouth is open in these; else do nothing.",
    "markers.flat": "Export points in space, of markers all over the face.",
    "markers.motionless": "Nothing to do, if it is to be a take of the face at rest.",
    "markers.actor": "Nothing to do: the take is fitted as another actor's.",
    "markers.other_person": "Take this person's own rig, or fit it as another actor's: --actor.",
}
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


def report_faults(check: MarkerCheck, located: LocatedTake, limits: CheckLimits) -> None:
    """Add a finding for every label and fault, and what holds for all."""
    faults, labels = located.faults, located.face.labels
    take, rate = located.face.take, located.face.rate
    if faults.halted > limits.repeated:
        message = f"{faults.halted:.0%} of the frames repeat the one before."
        add(check, "markers.repeated", "warning", message, found=round(faults.halted, 3))
    for group in faults.doubles:
        names = quote_names([labels[each] for each in group])
        *others, last = names if len(group) <= limits.named else [*names[: limits.named], "others"]
        message = f"{', '.join(others)} and {last} are one marker."
        add(check, "markers.double", "warning", message, label=labels[group[0]], labels=names)
    gone = faults.blanks(round(limits.gone * rate))
    if gone:
        spans = [[take.numbers[first], take.numbers[last]] for first, last in gone]
        longest = max(last - first + 1 for first, last in gone) / rate
        number = count_words(len(gone), "span", "spans")
        message = f"No marker is seen in {number}, up to {longest:.1f} s."
        add(check, "markers.gone", "warning", message, frames=spans[: limits.spans])
    for marker, span in sorted(faults.moved.items()):
        frame = take.numbers[span.first]
        message = f"{quote(labels[marker])} sits {span.mm:.1f} mm elsewhere from frame {frame} on."
        figures = {"label": labels[marker], "frame": frame, "found": round(span.mm, 1)}
        add(check, "markers.moved", "warning", message, **figures)
    for fault in FAULT_WORDS:
        _report_fault(check, located, fault, gone, limits)
    frames = len(take)
    wrong, missing = faults.share(*WRONG), faults.share("missing")
    check.figures |= {"wrong": round(wrong, 4), "missing": round(missing, 4)}
    if wrong > limits.wrong:
        message = f"{wrong:.0%} of the markers' time in {frames} frames is wrong."
        add(check, "markers.wrong", "error", message, found=round(wrong, 3), expected=limits.wrong)


def _report_fault(
    check: MarkerCheck,
    located: LocatedTake,
    fault: str,
    gone: Sequence[tuple[int, int]],
    limits: CheckLimits,
) -> None:
    """Add a finding for each label with a fault, the worst first; the last counts the others."""
    found, labels, frames = [], located.face.labels, len(located.face.take)
    for marker, others in located.faults.by_marker(fault).items():
        for other, spans in others.items():
            own = [span for span in spans if (span.first, span.last) not in gone]
            twice = fault == "swapped" and other is not None and other < marker
            if own and not twice:
                found.append((sum(span.frames for span in own) / frames, marker, other, own))
    found.sort(key=lambda each: -each[0])
    shown = [each for each in found[: limits.labels] if not _is_short_gap(fault, each[0], limits)]
    for share, marker, other, spans in shown:
        _report_spans(check, located, fault, (marker, other), spans, share, limits)
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


def _is_short_gap(fault: str, share: float, limits: CheckLimits) -> bool:
    return fault == "missing" and share < limits.long_missing


def _report_spans(
    check: MarkerCheck,
    located: LocatedTake,
    fault: str,
    pair: tuple[int, int | None],
    spans: list[Span],
    share: float,
    limits: CheckLimits,
) -> None:
    """Add the finding of one label, and of the ``pair``'s other where it takes that one's place."""
    (marker, other), labels, numbers = pair, located.face.labels, located.face.take.numbers
    count = sum(span.frames for span in spans)
    severity: Severity = "info" if fault == "filled" else "warning"
    if fault in ("outlier", "ghost", "frozen") and share < limits.seldom:
        severity = "info"
    listed = [[numbers[span.first], numbers[span.last]] for span in spans]
    what = FAULT_WORDS[fault] if other is None else f"{FAULT_WORDS[fault]} {quote(labels[other])}"
    where = f"frames {listed[0][0]} to {listed[0][1]}" if count > 1 else f"frame {listed[0][0]}"
    if len(spans) > 1:
        where = f"{len(spans)} spans, {count} frames, the first {listed[0][0]} to {listed[0][1]}"
    most = max(span.mm for span in spans)
    off = f" by up to {most:.0f} mm" if fault in ("outlier", "ghost") else ""
    figures: dict[str, Any] = {"label": labels[marker], "frames": listed[: limits.spans]}
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


def report_unlabelled(check: MarkerCheck, located: LocatedTake, limits: CheckLimits) -> None:
    """Add which unlabelled tracks lie where a missing marker is expected."""
    faults, take = located.faults, located.face.take
    if not take.unlabelled_names:
        return
    motion, missing = faults.motion, ~np.isfinite(faults.motion.places[..., 0])
    fits = []
    for track, name in enumerate(take.unlabelled_names):
        frames = np.flatnonzero(np.isfinite(take.unlabelled[:, track, 0]))
        if not len(frames):
            continue
        points = located.face.mm * take.unlabelled[frames, track]
        placed = np.einsum("fij,fj->fi", motion.rotations[frames], points) + motion.shifts[frames]
        away = np.linalg.norm(motion.expected[frames] - placed[:, None], axis=2)
        near = (missing[frames] & (away < limits.fills)).mean(axis=0)
        best = int(np.argmax(near))
        if near[best] > limits.share_filled:
            label = located.face.labels[best]
            spans = [[take.numbers[frames[0]], take.numbers[frames[-1]]]]
            fits.append({"track": quote(name), "label": quote(label), "frames": spans})
    message = f"{count_words(len(take.unlabelled_names), 'track has', 'tracks have')} no label"
    if fits:
        shown = ", ".join(f"{each['track']} is {each['label']}" for each in fits[:3])
        message += f"; {count_words(len(fits), 'fills', 'fill')} gaps of a marker: {shown}"
    add(check, "markers.unlabelled", "info", f"{message}.", tracks=fits[:MOST_NAMES])


# Where the face is.


def report_location(check: MarkerCheck, located: LocatedTake, pose: Located) -> None:
    """Add unit and axes, and what is mirrored or exchanged."""
    take, labels = located.face.take, located.face.labels
    rotation = pose.session.rotation
    read = ScanUnit(take.unit_mm, "assumed")
    unit = ScanUnit(take.unit_mm * pose.unit.mm_per_unit, pose.unit.source)  # of the file
    up, forward = nearest_axis(rotation[1]), nearest_axis(rotation[2])
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


def count_words(number: int, one: str, many: str) -> str:
    """Return a number with its noun, and a verb, in the singular or the plural."""
    return f"{number} {one if number == 1 else many}"
