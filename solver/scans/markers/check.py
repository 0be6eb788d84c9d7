"""The check of a take of markers: whether it is usable, and which label is wrong, when and how.

A bad take is no exception but a verdict. Findings (``findings.py``) name the label, the frames and
what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from solver.errors import Severity, quote, quote_names
from solver.mechanics.boundary import jaw_rotation
from solver.model import JawFrame
from solver.scans.markers.bind import (
    USUAL_RATE,
    BindOptions,
    count_tracks,
    crowded_error,
    find_neutral,
    place_markers,
    rest_places,
    rest_points,
    rough_unit,
    usual_distances,
)
from solver.scans.markers.faults import find_faults
from solver.scans.markers.findings import (
    LIMITS,
    CheckLimits,
    MarkerCheck,
    add,
    count_words,
    label_rows,
    tell_dead,
    tell_exchanged,
    tell_faults,
    tell_location,
    tell_unlabelled,
)
from solver.scans.markers.locate import locate
from solver.scans.markers.marker_set import Marker, MarkerSet
from solver.scans.markers.motion import Mask
from solver.scans.markers.names import LOWER, Named, read_names
from solver.scans.markers.take import Take
from solver.similarity import robust_motion
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class Reference:
    """What a take is held against: the built-in face, or a person with or without a marker set."""

    face: Surface
    model_sha256: str = ""  # of the person's model; empty for a face that is nobody's
    markers: MarkerSet | None = None
    jaw: tuple[JawFrame, Floats] | None = None  # and its b (5,), if the face shows an expression


def check_take(
    take: Take,
    reference: Reference,
    neutral: tuple[int, int] | None = None,
    *,
    actor: bool = False,
    limits: CheckLimits = LIMITS,
) -> MarkerCheck:
    """Check a take; ``neutral`` are frames, from 0, ``actor`` says that it is another person's."""
    take = count_tracks(take)
    check = MarkerCheck([each for each in take.findings if each.code != "markers.two_faces"])
    named = read_names(take.labels)
    rate = _check_rate(check, take, limits)
    alive = np.asarray(np.isfinite(take.positions[..., 0]).any(axis=0))
    if alive.sum() > BindOptions.most:
        error = crowded_error(take.file, int(alive.sum()), BindOptions.most)
        add(check, error.code, "error", error.message, **error.context)
        return check
    mm = rough_unit(take.positions[:, alive])
    is_face = _choose_face(check, take, named, alive, mm, limits)
    check.figures |= {
        "frames": len(take),
        "first": take.first,
        "rate": None if np.isnan(take.rate) else take.rate,
        "labels": len(take.labels),
        "markers": int(is_face.sum()),
        "unlabelled": len(take.unlabelled_names),
    }
    tell_dead(check, take, np.flatnonzero(~alive))
    if _are_few(check, take, int(is_face.sum()), limits):
        return check
    check.markers = np.flatnonzero(is_face)
    faults = find_faults(mm * take.positions[:, is_face], rate)
    check.faults = faults
    doubles = sum(len(group) - 1 for group in faults.doubles)
    if doubles and _are_few(check, take, int(is_face.sum()) - doubles, limits):
        return check
    tell_faults(check, take, rate, limits)
    tell_unlabelled(check, take, mm, limits)
    first, last = neutral or find_neutral(faults.motion, rate)
    check.figures["neutral"] = [take.numbers[first], take.numbers[last]]
    points = rest_points(faults.motion, (first, last)) / mm
    _tell_rest(check, take, rate, (first, last), is_given=neutral is not None, limits=limits)
    on_face = [named[number] for number in check.markers.tolist()]
    located = locate(points, on_face, reference.face)
    check.labels = label_rows(check, take)
    if located is None:
        message = f"Frames {take.numbers[first]} to {take.numbers[last]} show too few markers."
        add(check, "markers.neutral", "warning", message)
        return check
    check.located, check.placed = located, located.session(points)
    tell_location(check, take, located)
    if reference.model_sha256:
        labels = [take.labels[number] for number in check.markers.tolist()]
        _tell_person(check, take, reference, labels, on_face, actor=actor, limits=limits)
        markers = place_markers(labels, on_face, check.placed, reference.face)
        if reference.jaw is not None:
            markers = tuple(_close_jaw(each, *reference.jaw) for each in markers)
        check.bound = MarkerSet(markers, located.session, reference.model_sha256)
    return check


# The file: rate, unit, whose markers these are.


def _check_rate(check: MarkerCheck, take: Take, limits: CheckLimits) -> float:
    if take.rate > 0:
        if take.rate < limits.slow:
            message = f"{take.rate:g} frames a second are few: what is sudden cannot be told."
            add(check, "markers.rate", "warning", message, found=take.rate)
        return take.rate
    if not any(found.code == "markers.rate" for found in take.findings):
        message = f"{take.file} does not say its frame rate; {USUAL_RATE:g} are assumed."
        add(check, "markers.rate", "warning", message, expected=USUAL_RATE)
    return USUAL_RATE


def _are_few(check: MarkerCheck, take: Take, count: int, limits: CheckLimits) -> bool:
    """Tell whether nothing more can be said of so few markers, or of points in no known unit."""
    if count < limits.least:
        seen = count_words(count, "marker", "markers")
        message = f"{take.file} has {seen} of a face; {limits.least} are needed."
        add(check, "markers.few", "error", message, found=count, expected=limits.least)
    stops = "markers.few", "markers.unit"
    return any(each.code in stops and each.severity == "error" for each in check.findings)


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
        apart = mm * usual_distances(take.positions[:, numbers])
        _, group = connected_components(np.nan_to_num(apart, nan=np.inf) < limits.linked)
        sizes = np.bincount(group)
        order = np.argsort(-sizes, kind="stable")
        is_face[numbers[group != order[0]]] = False
        another = len(order) > 1 and sizes[order[1]] >= max(
            limits.second * sizes[order[0]], limits.least_second
        )
        if another:
            ours, theirs = ([take.labels[n] for n in numbers[group == each]] for each in order[:2])
            message = f"{take.file} shows two faces, of {len(ours)} and {len(theirs)} markers."
            figures = {"first": quote_names(ours), "second": quote_names(theirs)}
            add(check, "markers.two_faces", "error", message, **figures)
        outside |= alive & ~is_face
    names = [take.labels[number] for number in np.flatnonzero(outside)]
    if names and not any(each.code == "markers.two_faces" for each in check.findings):
        message = f"{count_words(len(names), 'label is', 'labels are')} not on the face."
        add(check, "markers.outside", "info", message, labels=quote_names(names))
    return np.asarray(is_face)


# Where the face is, and whose.


def _tell_rest(
    check: MarkerCheck,
    take: Take,
    rate: float,
    neutral: tuple[int, int],
    *,
    is_given: bool,
    limits: CheckLimits,
) -> None:
    """Tell whether the frames at rest show most of the markers, and these lie still."""
    assert check.faults is not None
    motion, (first, last) = check.faults.motion, neutral
    places = motion.places[first : last + 1]
    seen = np.isfinite(places[..., 0])
    hidden = np.flatnonzero(~seen.any(axis=0))
    frames = f"frames {take.numbers[first]} to {take.numbers[last]}"
    figures: dict[str, Any] = {"frames": [take.numbers[first], take.numbers[last]]}
    stillest = ""
    if is_given:
        one, other = (take.numbers[row] for row in find_neutral(motion, rate))
        figures["stillest"] = [one, other]
        stillest = f" The stillest are {one} to {other}."
    if len(hidden) > (1.0 - limits.at_rest) * seen.shape[1]:
        names = quote_names([take.labels[check.markers[each]] for each in hidden.tolist()])
        number = f"{len(hidden)} of {seen.shape[1]} markers"
        message = f"{number} are not seen in {frames}.{stillest}"
        add(check, "markers.neutral", "warning", message, labels=names, **figures)
        return
    spread = np.sqrt(np.nanvar(places[:, seen.any(axis=0)], axis=0).sum(axis=1))
    unrest = float(np.median(spread))
    if unrest > limits.unrest:
        which = "these" if is_given else "the stillest"
        message = f"The face moves in {frames}, {which}, by {unrest:.1f} mm.{stillest}"
        add(check, "markers.neutral", "warning", message, found=round(unrest, 2), **figures)


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
    assert located is not None
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


def _close_jaw(marker: Marker, frame: JawFrame, b: Floats) -> Marker:
    """Return a marker with the place that it has at rest, if it rides on the mandible."""
    if marker.part != "lower_teeth" or marker.place_mm is None:
        return marker
    moved = np.asarray(marker.place_mm) - frame.origin - b[2:] @ frame.axes
    x, y, z = (frame.origin + jaw_rotation(frame, b).T @ moved).tolist()
    return replace(marker, place_mm=(x, y, z))


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
    _tell_unlike_set(check, markers, labels, len(known), limits)
    if len(known) < limits.least:
        return off
    there = goal[rows[known]]
    motion = robust_motion(check.placed[known], there, np.ones(len(known)), 3.0, 12)
    placed = motion(check.placed[known])
    apart = np.linalg.norm(placed[:, None] - there[None], axis=2)
    _, chosen = linear_sum_assignment(apart**2)
    off[known] = np.diag(apart)
    if np.median(off[known]) > limits.person:
        return off
    for row, column in enumerate(chosen.tolist()):
        if chosen[column] == row and row < column:
            tell_exchanged(check, labels[int(known[row])], labels[int(known[column])])
            off[known[[row, column]]] = np.nan
    for row in np.flatnonzero(off[known] > limits.misplaced).tolist():
        label, found = labels[int(known[row])], float(off[known[row]])
        message = f"{quote(label)} sits {found:.1f} mm from its place in the marker set."
        figures = {"label": label, "frame": check.figures["neutral"][0], "found": round(found, 1)}
        add(check, "markers.moved", "warning", message, **figures)
        off[known[row]] = np.nan
    return off


def _tell_unlike_set(
    check: MarkerCheck, markers: MarkerSet, labels: Sequence[str], known: int, limits: CheckLimits
) -> None:
    """Tell which labels only the take has, and which only the marker set."""
    used = [each.label for each in markers.markers if each.part != "ignore"]
    new = [label for label in labels if label not in markers.labels]
    missing = [label for label in used if label not in labels]
    said = []
    if new:
        names = ", ".join(quote_names(new[: limits.named]))
        said.append(f"{count_words(len(new), 'label is', 'labels are')} not in the set: {names}")
    if missing:
        names = ", ".join(quote_names(missing[: limits.named]))
        said.append(f"{count_words(len(missing), 'label', 'labels')} of it not here: {names}")
    few = known < limits.least
    if few:
        said.insert(0, f"{known} labels of the marker set are seen, {limits.least} are needed")
    if said:
        figures = {"new": quote_names(new), "missing": quote_names(missing)}
        severity: Severity = "error" if few else "warning" if new else "info"
        message = f"The marker set does not fit: {'; '.join(said)}."
        add(check, "markers.unlike_set", severity, message, **figures)


def _rms(off: Floats) -> float:
    known = off[np.isfinite(off)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0
