"""The check of a take of markers: whether it is usable, and which label is wrong, when and how.

A bad take is no exception but a verdict. Findings (``findings.py``) name the label, the frames and
what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from solver.drawing.render import Camera, DrawnBody, Lit, render
from solver.drawing.sheet import HEADER, MARGIN, Colour, Sheet
from solver.errors import Finding, InputError, Severity, count_words, quote, quote_names
from solver.registration.search import nose_tip
from solver.scans.markers.findings import (
    ACTOR_ADVICE,
    ADVICE,
    LIMITS,
    MarkerCheck,
    add,
    label_rows,
    report_exchanged,
    report_faults,
    report_location,
    report_mouth,
    report_off_skin,
    report_rest,
    report_unlabelled,
)
from solver.scans.markers.places.actor import ActorWarp, fit_warp
from solver.scans.markers.places.bind import BIND, Reference, place_take, places_of
from solver.scans.markers.places.face_take import FACE, USUAL_RATE, FaceMarkers, LocatedTake
from solver.scans.markers.places.marker_set import BONY, MarkerSet
from solver.scans.markers.prepare import PreparedTake, PrepareOptions
from solver.scans.markers.readers.names import LOWER
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.faults import Faults
from solver.scans.markers.signal.motion import is_motionless, refuse_flat, rms_of_seen
from solver.similarity import robust_motion
from solver.surface import Floats, Ints, Surface, vertex_normals


def check_take(
    take: Take, reference: Reference, neutral: tuple[int, int] | None = None, *, actor: bool = False
) -> MarkerCheck:
    """Check a take, at rest in the ``neutral`` rows; an ``actor`` is meant to be another person."""
    prepared = PreparedTake(take, reference, PrepareOptions(actor, neutral))
    check = MarkerCheck([each for each in take.findings if each.code != "markers.two_faces"])
    _check_rate(check, take)
    try:
        face = prepared.face
    except InputError as error:
        add(check, error.code, "error", error.message, **error.context)
        return check
    take = face.take
    check.figures |= {
        "frames": len(take),
        "first": take.first,
        "rate": None if np.isnan(take.rate) else take.rate,
        "labels": len(take.labels),
        "markers": len(face.numbers),
        "unlabelled": len(take.unlabelled_names),
    }
    _check_face(check, face)
    if _are_few(check, take, len(face.numbers)):
        return check
    located = check.located = prepared.location
    if located.distinct < len(face.numbers) and _are_few(check, take, located.distinct):
        return check
    report_faults(check, located)
    report_unlabelled(check, located)
    first, last = located.neutral
    check.figures["neutral"] = [take.numbers[first], take.numbers[last]]
    report_rest(check, located, is_given=neutral is not None)
    check.labels = label_rows(located)
    if located.pose is None:
        message = f"Frames {take.numbers[first]} to {take.numbers[last]} show too few markers."
        add(check, "markers.neutral", "warning", message)
        return check
    try:
        refuse_flat(take.file, located.points)
    except InputError as error:
        add(check, error.code, "error", error.message, **error.context)
        return check
    if is_motionless(located.faults.motion):
        message = "No marker moves against the others: the take shows one pose."
        add(check, "markers.motionless", "info", message)
    report_location(check, located, located.pose)
    if reference.model_sha256:
        check.bound = prepared.marker_set
        _check_person(check, located, reference, actor=actor)
        if not any(each.code == "markers.other_person" for each in check.findings):
            report_off_skin(check, located, check.bound)
    _check_mouth(check, located, reference)
    return check


def _check_rate(check: MarkerCheck, take: Take) -> None:
    if take.rate > 0:
        if take.rate < LIMITS.slow:
            message = f"{take.rate:g} frames a second are few: what is sudden cannot be seen."
            add(check, "markers.rate", "warning", message, found=take.rate)
    elif not any(found.code == "markers.rate" for found in take.findings):
        message = f"{take.file} has no frame rate; {USUAL_RATE:g} a second are assumed."
        add(check, "markers.rate", "warning", message, expected=USUAL_RATE)


def _check_face(check: MarkerCheck, face: FaceMarkers) -> None:
    """Add which labels are on another face, on no face, or never seen."""

    def names(numbers: Ints) -> list[str]:
        return quote_names([face.take.labels[number] for number in numbers.tolist()])

    if len(face.another):
        ours = len(face.numbers)
        theirs = len(face.another)
        message = f"{face.take.file} shows two faces, of {ours} and {theirs} markers."
        figures = {"first": quote_names(face.labels), "second": names(face.another)}
        add(check, "markers.two_faces", "error", message, **figures)
    elif len(face.outside):
        message = f"{count_words(len(face.outside), 'label is', 'labels are')} not on the face."
        add(check, "markers.outside", "info", message, labels=names(face.outside))
    if len(face.dead):
        dead = names(face.dead)
        number = count_words(len(face.dead), "label is", "labels are")
        add(
            check,
            "markers.dead",
            "info",
            f"{number} never seen: {', '.join(dead[:4])}.",
            labels=dead,
        )


def _are_few(check: MarkerCheck, take: Take, count: int) -> bool:
    """Tell whether the check ends here: too few markers, two faces, or points in no known unit."""
    if count < FACE.least:
        seen = count_words(count, "marker", "markers")
        message = f"{take.file} has {seen} of a face; {FACE.least} are needed."
        add(check, "markers.few", "error", message, found=count, expected=FACE.least)
    stops = "markers.few", "markers.unit"
    return any(each.code in stops and each.severity == "error" for each in check.findings)


def _check_person(
    check: MarkerCheck, located: LocatedTake, reference: Reference, *, actor: bool
) -> None:
    """Check that the markers at rest fit the person: the skin, or the places of a marker set."""
    assert located.pose is not None
    names = located.face.names
    is_lower = np.array([each is not None and each.region in LOWER for each in names], bool)
    off = located.pose.off_skin
    if reference.markers is not None:
        off = _off_places(check, located, reference, reference.markers, actor=actor)
    others = rms_of_seen(off[~is_lower])
    jaw = rms_of_seen(off[is_lower])
    all_ = rms_of_seen(off)
    check.figures["off_person_mm"] = round(all_, 2)
    if others <= LIMITS.person and jaw > LIMITS.open_mouth:
        first, last = check.figures["neutral"]
        message = (
            f"In frames {first} to {last}, taken for rest, the mouth is open: markers of the jaw "
            f"are {jaw:.1f} mm off, the others {others:.1f} mm."
        )
        severity: Severity = "error" if jaw > LIMITS.wide_open else "warning"
        add(check, "markers.neutral", severity, message, found=round(jaw, 1))
    elif actor:
        _check_actor(check, located, reference)
    elif max(others, all_) > LIMITS.person:
        message = (
            f"At rest the markers of {located.face.take.file} are {all_:.1f} mm off this person."
        )
        severity = "warning" if _may_be_actor(located, reference) else "error"
        figures = {"found": round(all_, 2), "expected": LIMITS.person}
        add(check, "markers.other_person", severity, message, **figures)


def _check_actor(check: MarkerCheck, located: LocatedTake, reference: Reference) -> None:
    """Add how the markers are carried to the person, or why the fit will refuse to."""
    markers = reference.markers or check.bound
    assert markers is not None, "bound before"
    try:
        warp = _warp_to(located, reference, markers)
    except InputError as error:
        advice = ACTOR_ADVICE.get(error.code, ADVICE.get(error.code, ""))
        check.findings.append(Finding(error.code, "error", error.message, advice, error.context))
        return
    scale = warp.similarity.scale
    missed = rms_of_seen(warp.missed)
    left = rms_of_seen(warp.left)
    message = (
        f"The fit carries the motion to this person, at {scale:.2f} times the actor's size: the "
        f"markers at rest are {missed:.1f} mm off by that, {left:.1f} mm by the warp."
    )
    figures = {"scale": round(scale, 4), "missed_mm": round(missed, 2), "left_mm": round(left, 2)}
    add(check, "markers.actor", "info", message, **figures)


def _may_be_actor(located: LocatedTake, reference: Reference) -> bool:
    """Tell whether the markers could be carried to the person as another actor's."""
    pose = located.pose
    markers = reference.markers
    assert pose is not None
    if markers is None:
        if pose.similar is None:
            return False  # the labels do not name their places
        placed = place_take(located, pose, reference, actor=True)
        markers = reference.bind(placed, pose.session)
    try:
        _warp_to(located, reference, markers)
    except InputError:
        return False
    return True


def _warp_to(located: LocatedTake, reference: Reference, markers: MarkerSet) -> ActorWarp:
    """Return the way of the markers at rest to a set's places, as the fit of an actor goes."""
    face = located.face
    session = markers.session
    bony = {each.label for each in markers.markers if each.part in BONY}
    on_bone = np.array([label in bony for label in face.labels], bool)
    goal = places_of(face.labels, markers, reference.places(markers))
    rest = session.scale * located.points
    return fit_warp(face.take.file, rest, goal, on_bone, session.rotation)


def _check_mouth(check: MarkerCheck, located: LocatedTake, reference: Reference) -> None:
    """Check that the mouth is closed at rest, if nothing was found odd with that yet."""
    if any(each.code == "markers.neutral" for each in check.findings):
        return
    if reference.markers is not None:
        labels = located.face.labels
        known = reference.markers
        report_mouth(check, located, places_of(labels, known, reference.places(known)))
    elif reference.jaw is None:  # names tell of closed lips
        report_mouth(check, located, None)


def _off_places(
    check: MarkerCheck,
    located: LocatedTake,
    reference: Reference,
    markers: MarkerSet,
    *,
    actor: bool,
) -> Floats:
    """Return how far (n,) labels are from their places in a marker set; reports the odd ones.

    An ``actor`` has another face: no distance counts as odd there.
    """
    placed = located.places
    labels = located.face.labels
    assert placed is not None
    goal = places_of(labels, markers, reference.places(markers))
    known = np.flatnonzero(np.isfinite(goal[:, 0]) & np.isfinite(placed[:, 0]))
    off = np.full(len(labels), np.nan)
    _check_labels(check, markers, labels, len(known))
    if len(known) < FACE.least:
        return off
    there = goal[known]
    motion = robust_motion(placed[known], there, np.ones(len(known)), BIND.slack, BIND.steps)
    apart = np.linalg.norm(motion(placed[known])[:, None] - there[None], axis=2)
    _, chosen = linear_sum_assignment(apart**2)
    off[known] = np.diag(apart)
    if actor or np.median(off[known]) > LIMITS.person:
        return off
    for row, column in enumerate(chosen.tolist()):
        if chosen[column] == row and row < column:
            report_exchanged(check, labels[int(known[row])], labels[int(known[column])])
            off[known[[row, column]]] = np.nan
    for row in np.flatnonzero(off[known] > LIMITS.misplaced).tolist():
        label = labels[int(known[row])]
        found = float(off[known[row]])
        message = f"{quote(label)} sits {found:.1f} mm from its place in the marker set."
        figures = {"label": label, "frame": check.figures["neutral"][0], "found": round(found, 1)}
        add(check, "markers.moved", "warning", message, **figures)
        off[known[row]] = np.nan
    return off


def _check_labels(
    check: MarkerCheck, markers: MarkerSet, labels: Sequence[str], known: int
) -> None:
    """Report labels that only the take has, or only the marker set."""
    used = [each.label for each in markers.for_take(labels).used]
    new = [label for label in labels if label not in markers.labels]
    missing = [label for label in used if label not in labels]
    words = []
    if new:
        names = ", ".join(quote_names(new[: LIMITS.named]))
        words.append(f"{count_words(len(new), 'label is', 'labels are')} not in the set: {names}")
    if missing:
        names = ", ".join(quote_names(missing[: LIMITS.named]))
        words.append(f"{count_words(len(missing), 'label', 'labels')} of it not here: {names}")
    few = known < FACE.least
    if few:
        words.insert(0, f"{known} labels of the marker set are seen, {FACE.least} are needed")
    if words:
        figures = {"new": quote_names(new), "missing": quote_names(missing)}
        severity: Severity = "error" if few else "warning" if new else "info"
        message = f"The marker set does not fit: {'; '.join(words)}."
        add(check, "markers.unlike_set", severity, message, **figures)


# The picture of a check: the face with its markers, and a lane for every label.


WIDTH = 430  # pixels of a view
HEIGHT = 560  # pixels of a view
YAWS = (0.0, np.radians(55))  # of the views
SPAN_MM = 250.0  # height of a view
BACK_MM = 55.0  # its middle behind the tip of the nose
LANES = 620  # pixels; a lane's width
LANE = 13  # pixels; its height
NAMES = 150  # pixels; room for its name
LEAST_FACING = 0.15  # cosine: a marker that is seen more from the side is not drawn
NAME = (62, 9)  # pixels about a name in which no other is written
SKIN = np.array([0.62, 0.60, 0.58])
SEEN: Colour = (0.20, 0.55, 0.33)  # of markers without a fault
FAULTS: dict[str, tuple[str, Colour]] = {  # later ones are drawn over earlier ones
    "filled": ("filled in", (0.55, 0.78, 0.92)),
    "moved": ("sits elsewhere", (0.30, 0.42, 0.85)),
    "frozen": ("frozen", (0.55, 0.35, 0.70)),
    "outlier": ("thrown off", (0.86, 0.12, 0.14)),
    "ghost": ("another thing", (0.60, 0.10, 0.35)),
    "swapped": ("swapped", (0.95, 0.60, 0.10)),
    "relabelled": ("in another's place", (0.80, 0.70, 0.10)),
    "missing": ("missing", (0.84, 0.84, 0.85)),
}


def check_picture(check: MarkerCheck, face: Surface, title: str, path: Path) -> None:
    """Write the picture of a check as PNG; without a face in the take it holds only the title."""
    located = check.located
    names = [] if located is None else list(located.face.labels)
    rows = max(HEIGHT, LANE * len(names))
    legend = {"seen": SEEN, **dict(FAULTS.values())}
    width = WIDTH * len(YAWS) + NAMES + LANES + 2 * MARGIN
    page = Sheet.with_legend(title, _detail(check), legend, width, HEADER + rows + 36)
    if located is not None:
        colours = _colours(located.faults)
        if located.places is not None:
            for number, yaw in enumerate(YAWS):
                _draw_face(page, face, located.places, names, colours, yaw, WIDTH * number)
        _draw_lanes(page, located, WIDTH * len(YAWS) + NAMES)
    page.save(path)


def _detail(check: MarkerCheck) -> str:
    figures = check.figures
    words = [f"{figures.get('markers', 0)} markers", f"{figures.get('frames', 0)} frames"]
    if figures.get("rate"):
        words.append(f"{figures['rate']:g} a second")
    if "neutral" in figures:
        words.append("neutral: frames {} to {}".format(*figures["neutral"]))
    if "off_skin_mm" in figures:
        words.append(f"{figures['off_skin_mm']:.1f} mm off the skin")
    return ", ".join(words)


def _colours(faults: Faults) -> list[Colour]:
    """Return a colour for each marker: of the last of its faults in :data:`FAULTS`, but gaps."""
    found = [SEEN] * faults.usable.shape[1]
    for fault, (_, colour) in FAULTS.items():
        for span in faults.of(fault):
            if fault not in ("missing", "filled"):
                found[span.marker] = colour
    return found


def _draw_face(
    page: Sheet,
    face: Surface,
    placed: Floats,
    names: list[str],
    colours: list[Colour],
    yaw: float,
    left: int,
) -> None:
    centre = nose_tip(face) - np.array([0.0, 0.0, BACK_MM])
    camera = Camera(centre, SPAN_MM, yaw)
    light = 0.35 + 0.65 * camera.brightness(vertex_normals(face))
    lit = Lit(face, np.repeat(light[:, None], 3, axis=1))
    body = DrawnBody(lit, np.tile(SKIN, (len(light), 1)))
    page.panel((left, HEADER), render([body], camera, WIDTH, HEIGHT))
    pixels = camera.project(np.nan_to_num(placed), WIDTH, HEIGHT)
    backward = vertex_normals(face)[KDTree(face.vertices).query(np.nan_to_num(placed))[1]]
    written: list[tuple[int, int]] = []
    is_good = np.array([colour == SEEN for colour in colours])
    for number in np.lexsort((pixels[:, 2], is_good)).tolist():  # names of the odd ones first
        column, row, _ = pixels[number]
        is_inside = 0 < row < HEIGHT and 0 < column < WIDTH
        is_hidden = backward[number] @ camera.axes[2] < LEAST_FACING
        if np.isnan(placed[number, 0]) or is_hidden or not is_inside:
            continue
        x = left + round(column)
        y = HEADER + round(row)
        fill = tuple(round(255 * value) for value in colours[number])
        page.draw.ellipse([x - 5, y - 5, x + 5, y + 5], fill=fill, outline=(30, 30, 30))
        if all(abs(x - a) > NAME[0] or abs(y - b) > NAME[1] for a, b in written):
            page.text((x + 7, y - 6), quote(names[number])[:14], 10)
            written.append((x, y))


def _draw_lanes(page: Sheet, located: LocatedTake, left: int) -> None:
    """Draw when each label is seen and what is wrong with it, the take from left to right."""
    faults = located.faults
    names = located.face.labels
    frames = len(faults.usable)
    tall = LANE - 3

    def bar(row: int, first: int, last: int, colour: Colour) -> None:
        x = left + LANES * first // frames
        y = HEADER + LANE * row
        end = max(x + 1, left + LANES * (last + 1) // frames)  # a frame is seen, too
        fill = tuple(round(255 * value) for value in colour)
        page.draw.rectangle([x, y, end, y + tall], fill=fill)

    for row, name in enumerate(names):
        page.text((left - 8, HEADER + LANE * row + tall // 2), quote(name)[:20], 10, anchor="rm")
        bar(row, 0, frames - 1, SEEN)
    for fault, (_, colour) in FAULTS.items():
        for span in faults.of(fault):
            bar(span.marker, span.first, span.last, colour)
    first, last = located.neutral
    x, end = (left + LANES * row // frames for row in (first, last + 1))
    y = HEADER + LANE * len(names) + 3
    page.draw.rectangle([x, y, end, y + 4], fill=(40, 40, 40))
    page.text(((x + end) // 2, y + 8), "neutral", 10, anchor="ma")
