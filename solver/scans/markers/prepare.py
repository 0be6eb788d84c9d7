"""A take on a person: its face found and bound, and for a fit carried and mended.

A check, a binding and a fit ask one :class:`PreparedTake`, each as far as it goes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from solver.errors import Finding, InputError, make_warning
from solver.model import SubjectModel
from solver.scans.markers.findings import (
    LIMITS,
    MarkerCheck,
    report_mouth,
    report_off_skin,
    report_rest,
)
from solver.scans.markers.places.actor import carry, off_places
from solver.scans.markers.places.bind import (
    Expression,
    Reference,
    onto_places,
    place_on,
    place_take,
    places_of,
    rest_places,
)
from solver.scans.markers.places.face_take import (
    FACE,
    USUAL_RATE,
    FaceMarkers,
    LocatedTake,
    choose_face,
    living_labels,
    locate_take,
)
from solver.scans.markers.places.locate import Located
from solver.scans.markers.places.marker_set import BoundTake, Marker, MarkerSet, span_label
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.faults import Faults, find_faults
from solver.scans.markers.signal.motion import (
    Motion,
    is_motionless,
    median_of_seen,
    refuse_flat,
    still_seconds,
)
from solver.scans.markers.signal.rest import REST
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class PrepareOptions:
    """Facts known of a take, and the limits of binding it."""

    actor: bool = False  # it is another person's, whose motion is carried over
    neutral: tuple[int, int] | None = None  # first and last row at which the face is at rest
    rate: float = 0.0  # frames a second; 0 is what the take says, or the usual
    least: int = 4  # markers of the set that a frame has to have


@dataclass(frozen=True)
class Binding:
    """A marker set for a take, and where the take's face lies."""

    markers: MarkerSet
    pose: Located
    neutral: tuple[int, int]  # first and last row of the take at rest
    findings: tuple[Finding, ...] = ()  # what to look at before the set is used


@dataclass(frozen=True)
class MendedTake:
    """A take to be fitted; ``carried`` is what a report says of another actor's, {} without."""

    source: BoundTake
    carried: dict[str, Any]
    notices: list[Finding]


@dataclass(frozen=True)
class PreparedTake:
    """The steps from a take to a fit of it; each is taken once, when it is first asked for."""

    take: Take
    person: Reference  # with the take's marker set, if there is one
    options: PrepareOptions = PrepareOptions()

    @cached_property
    def face(self) -> FaceMarkers:
        """The labels that are on one face; raises as :func:`choose_face`."""
        return choose_face(self.take)

    @cached_property
    def location(self) -> LocatedTake:
        """The place of that face on the person at rest, with the faults of its markers."""
        options = self.options
        compared = bool(self.person.model_sha256) and not self.options.actor
        skin = self.person.face
        neutral = options.neutral
        return locate_take(self.face, skin, neutral, compared=compared)

    @cached_property
    def marker_set(self) -> MarkerSet:
        """The set of the markers where they lie; the face must have a pose."""
        pose = self.location.pose
        assert pose is not None, "asked for once the face is located"
        options = self.options
        markers = place_take(self.location, pose, self.person, actor=options.actor)
        return self.person.bind(markers, pose.session)

    @cached_property
    def binding(self) -> Binding:
        """The marker set, with findings to look at before it is used.

        Raises :class:`InputError`: ``markers.few``, not enough markers are seen at rest,
        ``markers.flat`` or ``markers.too_large``.
        """
        file = self.take.file
        options = self.options
        check = MarkerCheck()
        if len(self.face.numbers) < FACE.least:
            raise _few_error(file, len(self.face.numbers), "on the face")
        located = self.location
        if located.pose is None:
            seen = int(np.isfinite(located.points[:, 0]).sum())
            raise _few_error(file, seen, "seen at rest")
        refuse_flat(file, located.points)
        report_rest(check, located, is_given=options.neutral is not None)
        report_off_skin(check, located, self.marker_set)
        if self.person.jaw is None:
            report_mouth(check, located, None)
        return Binding(self.marker_set, located.pose, located.neutral, tuple(check.findings))

    @cached_property
    def mended_take(self) -> MendedTake:
        """The take ready to be fitted, bound by the person's marker set or its own.

        What stands still or was drawn is missing, labels that are swapped are exchanged, and a
        marker that moved is another one from then on. Raises :class:`InputError` for what cannot be
        bound, carried or fitted.
        """
        options = self.options
        skin = self.person.face
        notices = list[Finding]()
        take = self.take.pick(living_labels(self.take).tolist())
        rest = options.neutral
        rate = options.rate or (take.rate if take.rate > 0 else USUAL_RATE)
        markers = self.person.markers
        if markers is None:
            markers = self.binding.markers
            notices.extend(self.binding.findings)
            if options.actor:
                rest = self.binding.neutral  # the motions count from the frames whose places it has
        carried: dict[str, Any] = {}
        if options.actor:
            found = carry(take, markers, skin, rate, rest)
            take = found.take
            markers = found.markers
            carried = {"actor": found.report}
            notices.extend(found.notices)
        faults = find_faults(markers.session.scale * take.positions, rate)
        refuse_flat(take.file, faults.motion.middle)
        if is_motionless(faults.motion):
            message = (
                f"no marker of {take.file} moves against the others: there is no motion to fit"
            )
            notices.append(make_warning("markers.motionless", message))
        if not options.actor:
            notices.extend(_other_person(take, markers, faults.motion, skin, rate, rest))
        positions, exchanged = faults.put_right(take.positions)
        take, markers = split_moved(replace(take, positions=positions), markers, faults, skin)
        return MendedTake(BoundTake(take, markers, options.least, exchanged), carried, notices)


def bind(
    take: Take,
    model: SubjectModel,
    neutral: tuple[int, int] | None = None,
    *,
    expression: Expression | None = None,
    actor: bool = False,
) -> Binding:
    """Return where the markers of a take sit on ``model``, at rest in the ``neutral`` rows.

    Without these a still second is taken, to which the face comes back most, or in which the
    markers lie most like the face. With an ``expression`` the face shows that instead. An ``actor``
    is another person: see :func:`place_take`. Raises as :attr:`PreparedTake.binding`.
    """
    person = Reference.of(model, expression=expression)
    return PreparedTake(take, person, PrepareOptions(actor, neutral)).binding


def _few_error(file: str, found: int, where: str) -> InputError:
    message = f"{file}: {found} markers are {where}, {FACE.least} are needed"
    return InputError("markers.few", message, file=file, found=found)


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
    spans = [rest] if rest else [each.rows for each in still_seconds(motion, rate, REST.seconds)]
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


# Markers that moved within a take: a label and a place of its own for each span. One that fell off
# and was glued on beside its place is another marker from then on. How far it went is what its
# residuals (``signal/motion.py``) differ by before and after.


def split_moved(
    take: Take, markers: MarkerSet, faults: Faults, skin: Surface
) -> tuple[Take, MarkerSet]:
    """Give each marker that moved a label and a place of its own from then on, as ``LBRO1@312``.

    ``faults`` are of all labels of the take. The place in the set is of the span that lies nearer.
    Places of markers that moved in other takes are left out.
    """
    markers = markers.for_take(take.labels)
    if not faults.moved:
        return take, markers
    goal = places_of(take.labels, markers, rest_places(markers, skin))
    in_person = _in_person(faults.motion, markers, goal)
    labels = list(take.labels)
    columns = list(range(len(take.labels)))
    now = list(markers.markers)
    positions = take.positions.copy()
    for column, span in faults.moved.items():
        if in_person is None or np.isnan(goal[column, 0]):
            continue
        first = span.first
        row = markers.labels.index(labels[column])
        places = in_person[0][:, column]
        residuals = in_person[1][:, column]
        away = [median_of_seen(part) - goal[column] for part in (places[:first], places[first:])]
        step = median_of_seen(residuals[first:]) - median_of_seen(residuals[:first])
        is_of_first = np.linalg.norm(away[0]) <= np.linalg.norm(away[1])
        before = goal[column] if is_of_first else goal[column] - step
        label = span_label(labels[column], take.numbers[first])
        now.append(replace(_move_to(now[row], before + step, skin), label=label))
        now[row] = _move_to(now[row], before, skin)
        labels.append(label)
        columns.append(column)
        positions = np.concatenate([positions, positions[:, [column]]], axis=1)
        positions[:first, -1] = np.nan
        positions[first:, column] = np.nan
    split = replace(take.pick(columns), labels=tuple(labels), positions=positions)
    return split, replace(markers, markers=tuple(now))


def _in_person(motion: Motion, markers: MarkerSet, goal: Floats) -> tuple[Floats, Floats] | None:
    """Return places and residuals (f, k, 3) along the person's axes, by its places (k, 3) at rest.

    None if too few markers have a place.
    """
    turn = markers.session.rotation.T  # it mirrors if the take's axes are left-handed
    to_person = onto_places(motion.middle @ turn, goal)
    if to_person is None:
        return None
    return to_person(motion.places @ turn), to_person.turn(motion.residuals @ turn)


def _move_to(marker: Marker, place: Floats, skin: Surface) -> Marker:
    """Return a marker at another place: of the skin, or on its bone."""
    if marker.part == "face":
        return place_on(marker, place, skin)
    x, y, z = place.tolist()
    return replace(marker, place_mm=(x, y, z))
