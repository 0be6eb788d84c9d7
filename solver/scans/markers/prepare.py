"""Prepare a take for a fit: markers bound to the person, another actor's carried, labels mended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from solver.errors import Finding, make_warning
from solver.model import SubjectModel
from solver.scans.markers.actor import carry, off_places
from solver.scans.markers.bind import bind, model_face
from solver.scans.markers.face_take import FACE, frames_about, living_labels
from solver.scans.markers.faults import find_faults
from solver.scans.markers.findings import LIMITS
from solver.scans.markers.marker_set import BoundTake, MarkerSet
from solver.scans.markers.motion import Motion, still_seconds
from solver.scans.markers.moved import split_moved
from solver.scans.markers.shape import is_motionless, refuse_flat
from solver.scans.markers.take import Take
from solver.surface import Surface


@dataclass(frozen=True)
class PrepareOptions:
    """What is known of a take."""

    actor: bool = False  # it is another person's, whose motion is carried over
    neutral: int | None = None  # frame, as the file counts, at which the face is at rest
    least: int = 4  # markers of the set that it has to have


@dataclass(frozen=True)
class PreparedTake:
    """A take to be fitted; ``carried`` is what a report says of another actor's, {} without."""

    source: BoundTake
    carried: dict[str, Any]
    notices: list[Finding]


def prepare_take(
    take: Take,
    model: SubjectModel,
    rate: float,
    markers: MarkerSet | None = None,
    options: PrepareOptions = PrepareOptions(),
) -> PreparedTake:
    """Return a take of ``rate`` frames per second, ready to be fitted to a person.

    Without a set of ``markers`` these are bound by their names and places. What stands still or was
    drawn is missing, labels that are swapped are exchanged, and a marker that moved is another one
    from then on. Raises :class:`InputError` for what cannot be bound, carried or fitted.
    """
    skin, notices = model_face(model), list[Finding]()
    take = take.pick(living_labels(take).tolist())
    rest = frames_about(take, options.neutral, rate)
    if markers is None:
        bound = bind(take, model, rest, actor=options.actor)
        markers = bound.markers
        notices.extend(bound.findings)
        if options.actor:
            rest = bound.neutral  # the motions count from the frames whose places they are
    carried: dict[str, Any] = {}
    if options.actor:
        found = carry(take, markers, skin, rate, rest)
        take, markers, carried = found.take, found.markers, {"actor": found.report}
        notices.extend(found.notices)
    faults = find_faults(markers.session.scale * take.positions, rate)
    refuse_flat(take.file, faults.motion.middle)
    if is_motionless(faults.motion):
        message = f"no marker of {take.file} moves against the others: there is no motion to fit"
        notices.append(make_warning("markers.motionless", message))
    if not options.actor:
        notices.extend(_other_person(take, markers, faults.motion, skin, rate, rest))
    positions, exchanged = faults.put_right(faults.hide_unmeasured(take.positions))
    take, markers = split_moved(replace(take, positions=positions), markers, faults, skin)
    return PreparedTake(BoundTake(take, markers, options.least, exchanged), carried, notices)


def _other_person(
    take: Take,
    markers: MarkerSet,
    motion: Motion,
    skin: Surface,
    rate: float,
    rest: tuple[int, int] | None,
) -> list[Finding]:
    """Return the warning that a take is another person's, if its markers are so far off at rest."""
    # people are still in expressions, too
    spans = (
        [rest] if rest else [each.rows for each in still_seconds(motion, rate, FACE.rest.seconds)]
    )
    off_mm, rows = min((off_places(take, markers, motion, skin, each), each) for each in spans)
    if off_mm <= LIMITS.person:
        return []
    first, last = (take.numbers[row] for row in rows)
    message = (
        f"in frames {first} to {last} the markers of {take.file} are {off_mm:.1f} mm off their "
        "places: the face is not at rest there (neutral), or another person's (actor)"
    )
    figures = {"frames": [first, last], "found": round(off_mm, 2), "expected": LIMITS.person}
    return [make_warning("markers.other_person", message, figures)]
