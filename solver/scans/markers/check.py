"""The check of a take of markers: whether it is usable, and which label is wrong, when and how.

A bad take is no exception but a verdict. Findings name the label, the frames as the file counts
them, and what to do; every code has one advice, here, and ``docs/guide/markers.md`` lists the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from solver.errors import MOST_NAMES, Finding, Severity, quote, quote_names
from solver.registration.locate import nearest_axis
from solver.scans.markers.bind import (
    LOWER,
    BindOptions,
    Located,
    find_neutral,
    locate,
    place_markers,
    rest_places,
    rest_points,
)
from solver.scans.markers.faults import WRONG, Faults, Span, find_faults
from solver.scans.markers.marker_set import MarkerSet
from solver.scans.markers.motion import Mask
from solver.scans.markers.names import Named, read_names
from solver.scans.markers.take import Take
from solver.similarity import IDENTITY, robust_motion
from solver.surface import Floats, Ints, Surface

WHERE = "on the brows, the cheeks, the lips' rims, the chin, and four on a headband"
ADVICE = {
    # the file
    "markers.unit": "Export in millimetres, or go on: the unit was found by the face's size.",
    "markers.axes": "Nothing to do: the take is turned.",
    "markers.rate": "Export the take with its frame rate: speeds and the stillest second need it.",
    "markers.repeated": "Export at the rate of the recording: repeated frames hold nothing new.",
    "markers.mirrored": "Export with right-handed axes; until then the take is mirrored back.",
    "markers.sides": "Left is the person's own left: exchange the sides of the labels.",
    "markers.outside": "Nothing to do: these labels are left out.",
    "markers.unlabelled": "Label these tracks as the message says, or go on: they are candidates.",
    "markers.two_faces": "Export one person's markers a file.",
    "markers.few": f"Put more markers on the face: {WHERE}.",
    # single labels
    "markers.dead": "Nothing to do: the label is left out.",
    "markers.double": "Take one of the two labels out.",
    "markers.frozen": "Nothing to do: these frames count as missing.",
    "markers.filled": "Nothing to do, but gaps left open are filled better by the fit.",
    "markers.missing": "Nothing to do if they are short; else look for what hid the marker.",
    "markers.gone": "Nothing to do: these frames are predicted, and marked so.",
    "markers.swapped": "Exchange the two labels in these frames, or go on: the fit does.",
    "markers.relabelled": "Give the track the other label in these frames, or go on: the fit does.",
    "markers.exchanged": "Exchange the two labels in the whole take.",
    "markers.moved": "Bind the take a second time from this frame on: the marker sits elsewhere.",
    "markers.outlier": "Nothing to do: the fit leaves these frames of the label out.",
    "markers.ghost": "Nothing to do: a reflection took the label, and is left out.",
    "markers.wrong": "Clean the take, or take it again: too much of it is wrong.",
    # the person
    "markers.neutral": "Name frames with a relaxed face, lips closed, or the expression they show.",
    "markers.other_person": "Take this person's own rig, or carry the motion over: --actor.",
}

UNREADABLE = "Export the take again, as C3D, TRC or Motive CSV, and send the new file."


@dataclass(frozen=True)
class CheckLimits:
    """Beyond these a take has a finding; lengths in mm."""

    least: int = 4  # markers on a face
    wrong: float = 0.3  # of the markers' time: the take is bad
    seldom: float = 0.01  # of a label's time: outliers and ghosts are only told
    long_missing: float = 0.2  # of a label's time
    gone: float = 0.5  # s without any marker
    slow: float = 20.0  # frames a second; with fewer nothing sudden can be told
    repeated: float = 0.05  # of the frames
    linked: float = 100.0  # markers of one head lie no farther apart, one to the next
    second: float = 0.4  # of the first face's markers make another face ...
    least_second: int = 6  # ... if they are so many
    person: float = 3.0  # rms off the rig's skin, or off the places of a marker set
    open_mouth: float = 5.0  # rms of the jaw's markers, when the others fit
    misplaced: float = 4.0  # off the place in the set, when the others fit
    fills: float = 4.0  # an unlabelled track so near to where a missing marker is expected
    share_filled: float = 0.5  # of a track's frames
    spacing: tuple[float, float] = (6.0, 90.0)  # of neighbours on a face
    spans: int = 20  # of a finding that are listed
    labels: int = 12  # with a finding of their own; the others are counted


@dataclass
class MarkerCheck:
    """The findings of a check, its figures, and what its picture shows."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    labels: list[dict[str, Any]] = field(default_factory=list)  # a row for each
    markers: Ints = field(default_factory=lambda: np.zeros(0, np.int64))  # labels of the face
    faults: Faults | None = None  # of these
    located: Located | None = None
    placed: Floats | None = None  # (k, 3) these at rest, in the face's frame
    bound: MarkerSet | None = None  # proposed, if there is a rig


@dataclass(frozen=True)
class Reference:
    """What a take is held against: the built-in face, or a person with or without a marker set."""

    face: Surface
    model_sha256: str = ""  # of the person's model; empty for a face that is nobody's
    markers: MarkerSet | None = None


def check_take(
    take: Take,
    reference: Reference,
    neutral: tuple[int, int] | None = None,
    *,
    actor: bool = False,
    limits: CheckLimits = CheckLimits(),
) -> MarkerCheck:
    """Check a take; ``neutral`` are frames, from 0, ``actor`` says that it is another person's."""
    check = MarkerCheck(list(take.findings))
    named = read_names(take.labels)
    rate = _check_rate(check, take, limits)
    alive = np.isfinite(take.positions[..., 0]).any(axis=0)
    mm = _rough_unit(take.positions[:, alive], limits)
    is_face = _choose_face(check, take, named, alive, mm, limits)
    check.figures |= {
        "frames": len(take),
        "first": take.first,
        "rate": None if np.isnan(take.rate) else take.rate,
        "labels": len(take.labels),
        "markers": int(is_face.sum()),
        "unlabelled": len(take.unlabelled_names),
    }
    _tell(check, take, "dead", np.flatnonzero(~alive), "never seen")
    if is_face.sum() < limits.least:
        message = f"{take.file} has {is_face.sum()} markers of a face; {limits.least} are needed."
        add(check, "markers.few", "error", message, found=int(is_face.sum()), expected=limits.least)
        return check
    check.markers = np.flatnonzero(is_face)
    faults = find_faults(mm * take.positions[:, is_face], rate)
    check.faults = faults
    _tell_faults(check, take, rate, limits)
    _tell_unlabelled(check, take, mm, limits)
    first, last = neutral or find_neutral(faults.motion, rate)
    check.figures["neutral"] = [take.first + first, take.first + last]
    points = rest_points(faults.motion, (first, last)) / mm
    on_face = [named[number] for number in check.markers.tolist()]
    located = locate(points, on_face, reference.face)
    check.labels = _label_rows(check, take)
    if located is None:
        message = f"Frames {take.first + first} to {take.first + last} show too few markers."
        add(check, "markers.neutral", "warning", message)
        return check
    check.located, check.placed = located, located.session(points)
    _tell_location(check, take, located)
    if reference.model_sha256:
        labels = [take.labels[number] for number in check.markers.tolist()]
        _tell_person(check, take, reference, labels, on_face, actor=actor, limits=limits)
        markers = place_markers(labels, on_face, check.placed, reference.face, BindOptions())
        check.bound = MarkerSet(markers, located.session, reference.model_sha256)
    return check


def add(check: MarkerCheck, code: str, severity: Severity, message: str, **figures: Any) -> None:
    """Add a finding with the advice that belongs to its code."""
    check.findings.append(Finding(code, severity, message, ADVICE[code], figures))


# The file: rate, unit, whose markers these are.


def _check_rate(check: MarkerCheck, take: Take, limits: CheckLimits) -> float:
    if take.rate > 0:
        if take.rate < limits.slow:
            message = f"{take.rate:g} frames a second are few: what is sudden cannot be told."
            add(check, "markers.rate", "warning", message, found=take.rate)
        return take.rate
    message = f"{take.file} does not say its frame rate; 60 frames a second are assumed."
    add(check, "markers.rate", "warning", message, expected=60.0)
    return 60.0


def _rough_unit(positions: Floats, limits: CheckLimits) -> float:
    """Return the mm a unit that makes neighbours as far apart as on a face; 1 if it does."""
    if positions.shape[1] < limits.least:
        return 1.0
    apart = np.nan_to_num(_usual_distances(positions), nan=np.inf)
    np.fill_diagonal(apart, np.inf)
    spacing = float(np.median(np.sort(apart, axis=1)[:, 1]))  # the second: labels may be double
    low, high = limits.spacing
    return next((mm for mm in (1.0, 1000.0, 10.0, 0.1, 0.001) if low <= mm * spacing <= high), 1.0)


def _usual_distances(positions: Floats, frames: int = 40) -> Floats:
    """Return the median distances (k, k) of markers, NaN for those never seen together."""
    some = positions[np.unique(np.linspace(0, len(positions) - 1, frames).astype(int))]
    apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=3)
    found = np.full(apart.shape[1:], np.nan)
    known = np.isfinite(apart).any(axis=0)
    found[known] = np.nanmedian(apart[:, known], axis=0)
    return found


def _choose_face(
    check: MarkerCheck,
    take: Take,
    named: Sequence[Named | None],
    alive: Mask,
    mm: float,
    limits: CheckLimits,
) -> Mask:
    """Return which labels are of the one face that is checked."""
    is_body = np.array([each is not None and each.part == "ignore" for each in named], bool)
    is_face = alive & ~is_body
    numbers = np.flatnonzero(is_face)
    outside = alive & is_body
    if len(numbers) >= limits.least:
        apart = mm * _usual_distances(take.positions[:, numbers])
        _, group = connected_components(np.nan_to_num(apart, nan=np.inf) < limits.linked)
        sizes = np.bincount(group)
        order = np.argsort(-sizes, kind="stable")
        is_face[numbers[group != order[0]]] = False
        another = len(order) > 1 and sizes[order[1]] >= max(
            limits.second * sizes[order[0]], limits.least_second
        )
        if another:
            ours, theirs = (
                quote_names([take.labels[n] for n in numbers[group == each]]) for each in order[:2]
            )
            message = f"{take.file} shows two faces, of {len(ours)} and {len(theirs)} markers."
            add(check, "markers.two_faces", "error", message, first=ours, second=theirs)
        outside |= alive & ~is_face
    names = [take.labels[number] for number in np.flatnonzero(outside)]
    if names and not any(each.code == "markers.two_faces" for each in check.findings):
        message = f"{_count(len(names), 'label is', 'labels are')} not on the face."
        add(check, "markers.outside", "info", message, labels=quote_names(names))
    return is_face


def _tell_unlabelled(check: MarkerCheck, take: Take, mm: float, limits: CheckLimits) -> None:
    """Tell which unlabelled tracks lie where a missing marker is expected."""
    faults = check.faults
    assert faults is not None
    if not take.unlabelled_names:
        return
    motion, missing = faults.motion, ~np.isfinite(faults.motion.places[..., 0])
    fits = []
    for track, name in enumerate(take.unlabelled_names):
        frames = np.flatnonzero(np.isfinite(take.unlabelled[:, track, 0]))
        if not len(frames):
            continue
        turned = np.einsum("fij,fj->fi", motion.rotations[frames], mm * take.unlabelled[frames, track])
        away = np.linalg.norm(
            motion.expected[frames] - (turned + motion.shifts[frames])[:, None], axis=2
        )
        near = (missing[frames] & (away < limits.fills)).mean(axis=0)
        best = int(np.argmax(near))
        if near[best] > limits.share_filled:
            label = take.labels[int(check.markers[best])]
            spans = [[take.first + int(frames[0]), take.first + int(frames[-1])]]
            fits.append({"track": quote(name), "label": quote(label), "frames": spans})
    message = f"{_count(len(take.unlabelled_names), 'track has', 'tracks have')} no label"
    if fits:
        shown = ", ".join(f"{each['track']} is {each['label']}" for each in fits[:3])
        message += f"; {_count(len(fits), 'fills', 'fill')} gaps of a marker: {shown}"
    add(check, "markers.unlabelled", "info", f"{message}.", tracks=fits[:MOST_NAMES])


# Single labels.


SAID = {
    "frozen": "repeats its last place",
    "filled": "runs along a curve that a program has drawn",
    "missing": "is missing",
    "swapped": "is swapped with",
    "relabelled": "lies where another is expected:",
    "outlier": "is thrown off",
    "ghost": "is another thing between two gaps",
}


def _tell_faults(check: MarkerCheck, take: Take, rate: float, limits: CheckLimits) -> None:
    """Add a finding for every label and fault, and what holds for all."""
    faults = check.faults
    assert faults is not None
    labels = [take.labels[number] for number in check.markers.tolist()]
    if faults.halted > limits.repeated:
        message = f"{faults.halted:.0%} of the frames repeat the one before."
        add(check, "markers.repeated", "warning", message, found=round(faults.halted, 3))
    for a, b in faults.doubles:
        message = f"{quote(labels[a])} and {quote(labels[b])} are one marker."
        add(check, "markers.double", "warning", message, label=labels[a], other=labels[b])
    gone = faults.gone(round(limits.gone * rate))
    if gone:
        spans = [[take.first + first, take.first + last] for first, last in gone]
        longest = max(last - first + 1 for first, last in gone) / rate
        message = f"No marker is seen in {_count(len(gone), 'span', 'spans')}, up to {longest:.1f} s."
        add(check, "markers.gone", "warning", message, frames=spans[: limits.spans])
    for marker, span in sorted(faults.moved.items()):
        frame = take.first + span.first
        message = f"{quote(labels[marker])} sits {span.mm:.1f} mm elsewhere from frame {frame} on."
        figures = {"label": labels[marker], "frame": frame, "found": round(span.mm, 1)}
        add(check, "markers.moved", "warning", message, **figures)
    for fault in SAID:
        _tell_fault(check, take, labels, fault, gone, limits)
    frames = len(take)
    wrong, missing = faults.share(*WRONG), faults.share("missing")
    check.figures |= {"wrong": round(wrong, 4), "missing": round(missing, 4)}
    if wrong > limits.wrong:
        message = f"{wrong:.0%} of the markers' time in {frames} frames is wrong."
        add(check, "markers.wrong", "error", message, found=round(wrong, 3), expected=limits.wrong)


def _tell_fault(
    check: MarkerCheck,
    take: Take,
    labels: Sequence[str],
    fault: str,
    gone: Sequence[tuple[int, int]],
    limits: CheckLimits,
) -> None:
    """Add a finding for each label with a fault, the worst first; the last counts the others."""
    assert check.faults is not None
    told = []
    for marker, others in check.faults.by_marker(fault).items():
        for other, spans in others.items():
            own = [span for span in spans if (span.first, span.last) not in gone]
            twice = fault == "swapped" and other is not None and other < marker
            if own and not twice:
                told.append((sum(span.frames for span in own) / len(take), marker, other, own))
    told.sort(key=lambda each: -each[0])
    shown = [each for each in told[: limits.labels] if not _is_short_gap(fault, each[0], limits)]
    for share, marker, other, spans in shown:
        _tell_spans(check, take, labels, fault, (marker, other), spans, share, limits)
    others_ = told[len(shown) :]
    if others_:
        names = quote_names([labels[each[1]] for each in others_])
        which = "label has gaps", "labels have gaps"
        if fault != "missing":
            which = f"more label {SAID[fault]}", f"more labels: {SAID[fault]}"
        worst = f"at most {others_[0][0]:.1%} of the time, {names[0]}"
        severity: Severity = "warning" if fault in ("swapped", "relabelled") else "info"
        message = f"{_count(len(others_), *which)}, {worst}."
        add(check, f"markers.{fault}", severity, message, labels=names)


def _is_short_gap(fault: str, share: float, limits: CheckLimits) -> bool:
    return fault == "missing" and share < limits.long_missing


def _tell_spans(
    check: MarkerCheck,
    take: Take,
    labels: Sequence[str],
    fault: str,
    pair: tuple[int, int | None],
    spans: list[Span],
    share: float,
    limits: CheckLimits,
) -> None:
    """Add the finding of one label, and of the ``pair``'s other where it takes that one's place."""
    marker, other = pair
    count = sum(span.frames for span in spans)
    severity: Severity = "info" if fault == "filled" else "warning"
    if fault in ("outlier", "ghost", "frozen") and share < limits.seldom:
        severity = "info"
    listed = [[take.first + span.first, take.first + span.last] for span in spans]
    what = SAID[fault] if other is None else f"{SAID[fault]} {quote(labels[other])}"
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


def _tell(check: MarkerCheck, take: Take, fault: str, which: Ints, words: str) -> None:
    if len(which):
        names = quote_names([take.labels[number] for number in which.tolist()])
        message = f"{_count(len(which), 'label is', 'labels are')} {words}: {', '.join(names[:4])}."
        add(check, f"markers.{fault}", "info", message, labels=names)


def _label_rows(check: MarkerCheck, take: Take) -> list[dict[str, Any]]:
    """Return what a table of labels shows."""
    faults = check.faults
    assert faults is not None
    rows = []
    for number, label in enumerate(check.markers.tolist()):
        frames = {
            fault: sum(span.frames for span in faults.of(fault) if span.marker == number)
            for fault in (*SAID, "moved")
        }
        rows.append({"label": take.labels[label], "seen": len(take) - frames["missing"], **frames})
    return rows


# Where the face is, and whose.


def _tell_location(check: MarkerCheck, take: Take, located: Located) -> None:
    rotation = located.session.rotation
    up, forward = nearest_axis(rotation[1]), nearest_axis(rotation[2])
    check.figures |= {
        "unit": located.unit.name,
        "mm_per_unit": located.unit.mm_per_unit,
        "up": up,
        "forward": forward,
        "left_handed": located.mirrored,
        "by_names": located.by_names,
        "height_mm": round(located.height_mm, 1),
        "off_skin_mm": round(located.miss(), 2),
    }
    if located.unit.source != "assumed":
        times = located.unit.mm_per_unit
        message = f"Read as the file says, the face would be {times:.3g} times too small."
        if times < 1:
            message = f"Read as the file says, the face would be {1 / times:.3g} times too large."
        add(check, "markers.unit", "warning", message, found=times)
    if located.mirrored:
        message = f"{take.file} is mirrored: its axes are left-handed."
        add(check, "markers.mirrored", "warning", message)
    if located.sides_exchanged:
        message = "Labels of the left lie on the right, and those of the right on the left."
        add(check, "markers.sides", "warning", message)
    if (up, forward) != ("y", "z"):
        message = f"The face looks along {forward}, its top is at {up}."
        add(check, "markers.axes", "info", message, up=up, forward=forward)
    labels = [take.labels[number] for number in check.markers.tolist()]
    for a, b in located.exchanged:
        _tell_exchanged(check, labels[a], labels[b])


def _tell_exchanged(check: MarkerCheck, first: str, second: str) -> None:
    message = f"{quote(first)} and {quote(second)} lie in each other's place in the whole take."
    add(check, "markers.exchanged", "warning", message, label=first, other=second)


def _tell_person(
    check: MarkerCheck,
    take: Take,
    reference: Reference,
    labels: Sequence[str],
    named: Sequence[Named | None],
    *,
    actor: bool,
    limits: CheckLimits,
) -> None:
    """Tell whether the markers at rest fit the person: the skin, or the places of a marker set."""
    located = check.located
    assert located is not None and check.placed is not None
    is_lower = np.array([each is not None and each.region in LOWER for each in named], bool)
    off = located.off_skin
    if reference.markers is not None:
        off = _off_places(check, reference.markers, reference.face, labels, limits)
    others, jaw = _rms(off[~is_lower]), _rms(off[is_lower])
    check.figures["off_person_mm"] = round(_rms(off), 2)
    if others <= limits.person and jaw > limits.open_mouth:
        first, last = check.figures["neutral"]
        message = (
            f"In frames {first} to {last}, the stillest, the mouth is open: markers of the jaw "
            f"are {jaw:.1f} mm off, the others {others:.1f} mm."
        )
        add(check, "markers.neutral", "warning", message, found=round(jaw, 1))
    elif max(others, _rms(off)) > limits.person:
        message = f"At rest the markers of {take.file} are {_rms(off):.1f} mm off this person."
        severity: Severity = "info" if actor else "error"
        figures = {"found": round(_rms(off), 2), "expected": limits.person}
        add(check, "markers.other_person", severity, message, **figures)


def _off_places(
    check: MarkerCheck,
    markers: MarkerSet,
    face: Surface,
    labels: Sequence[str],
    limits: CheckLimits,
) -> Floats:
    """Return how far (k,) labels are from their places in a marker set; tells the odd ones."""
    assert check.placed is not None
    goal = rest_places(markers, face)
    number = {label: row for row, label in enumerate(markers.labels)}
    rows = np.array([number.get(label, -1) for label in labels])
    known = np.flatnonzero((rows >= 0) & np.isfinite(check.placed[:, 0]))
    known = known[np.isfinite(goal[rows[known], 0])]
    off = np.full(len(labels), np.nan)
    if len(known) < limits.least:
        return off
    there = goal[rows[known]]
    motion = robust_motion(check.placed[known], there, np.ones(len(known)), 3.0, 12, IDENTITY)
    placed = motion(check.placed[known])
    apart = np.linalg.norm(placed[:, None] - there[None], axis=2)
    _, chosen = linear_sum_assignment(apart**2)
    off[known] = np.diag(apart)
    if np.median(off[known]) > limits.person:
        return off
    for row, column in enumerate(chosen.tolist()):
        if chosen[column] == row and row < column:
            _tell_exchanged(check, labels[int(known[row])], labels[int(known[column])])
            off[known[[row, column]]] = np.nan
    for row in np.flatnonzero(off[known] > limits.misplaced).tolist():
        label, found = labels[int(known[row])], float(off[known[row]])
        message = f"{quote(label)} sits {found:.1f} mm from its place in the marker set."
        figures = {"label": label, "frame": check.figures["neutral"][0], "found": round(found, 1)}
        add(check, "markers.moved", "warning", message, **figures)
        off[known[row]] = np.nan
    return off


def _rms(off: Floats) -> float:
    known = off[np.isfinite(off)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
