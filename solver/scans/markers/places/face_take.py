"""The markers of one face in a take, and where they lie on a person at rest.

The labels of one face are chosen among those of bodies and of other faces (``choose_face``); that
face is found on the person's skin (:mod:`.locate`) in a second at rest (``signal/rest.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from solver.errors import InputError
from solver.registration.units import choose_unit, likely_unit
from solver.scans.markers.places.locate import LOCATE, NAMES_UNIT, Located, locate
from solver.scans.markers.readers.names import Named, read_names
from solver.scans.markers.readers.take import Take
from solver.scans.markers.signal.faults import Faults, find_faults
from solver.scans.markers.signal.motion import Mask, Motion, median_of_seen
from solver.scans.markers.signal.rest import Rest, likely_rests, rivals
from solver.surface import Floats, Ints, Surface

USUAL_RATE = 60.0  # frames a second, where a take has none


@dataclass(frozen=True)
class FaceOptions:
    """Limits of one face; lengths in mm."""

    most: int = 400  # markers: pairs of them are compared
    least: int = 4  # labels on a face; with fewer, tracks without one count as such
    spacing: tuple[float, float] = (6.0, 90.0)  # of neighbours on a face
    linked: float = 100.0  # markers of one head lie no farther apart, one to the next
    second: float = 0.4  # of the first face's markers make another face ...
    least_second: int = 6  # ... if they are so many
    least_on: float = 0.5  # of a face's markers are on the skin, or it is none
    resembles: float = 0.5  # of it: a pose that is so much more like the person is the rest


FACE = FaceOptions()


@dataclass(frozen=True)
class FaceMarkers:
    """A take of k labels, n of which are on one face."""

    take: Take  # tracks count as labels where it has none
    numbers: Ints  # (n,) labels of the face
    outside: Ints  # labels that are seen and not on it
    another: Ints  # those of them on a second face; none if there is no such face
    dead: Ints  # labels that are never seen
    names: tuple[Named | None, ...]  # (n,) places by the face's labels
    mm: float  # a unit of the take, by how far markers lie apart
    rate: float  # frames a second; the usual where the take has none

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the labels of the face."""
        return tuple(self.take.labels[number] for number in self.numbers.tolist())


@dataclass(frozen=True)
class LocatedTake:
    """The n markers of a face: what is wrong with them, and where they lie at rest."""

    face: FaceMarkers
    faults: Faults
    neutral: tuple[int, int]  # first and last row of the take at rest
    points: Floats  # (n, 3) at rest, in the axes and the unit of the take
    pose: Located | None  # where the face is under them; None if they are too few
    rest: Rest | None = None  # the pose at rest; None if its rows were given
    rival: Rest | None = None  # another, that may be rest as well

    @property
    def distinct(self) -> int:
        """Return how many markers there are, those with two labels once."""
        return len(self.points) - sum(len(group) - 1 for group in self.faults.doubles)

    @property
    def places(self) -> Floats | None:
        """Return the markers at rest (n, 3) in the person's frame."""
        return None if self.pose is None else self.pose.session(self.points)


def choose_face(take: Take) -> FaceMarkers:
    """Return a take with the labels that are on the face with the most of them.

    Raises :class:`InputError` ``markers.too_large`` for more markers than a face has.
    """
    take = count_tracks(take)
    named = read_names(take.labels)
    alive = np.zeros(len(take.labels), bool)
    alive[living_labels(take)] = True
    mm = _neighbours_unit(take.positions[:, alive])
    is_body = np.array([each is not None and each.part == "ignore" for each in named], bool)
    on_face, another = _largest_face(mm * take.positions, alive & ~is_body)
    by_names = _unit_by_names(take, on_face, named)
    if by_names not in (None, mm):
        mm = by_names
        on_face, another = _largest_face(mm * take.positions, alive & ~is_body)
    numbers = np.flatnonzero(on_face)
    return FaceMarkers(
        take,
        numbers,
        np.flatnonzero(alive & ~on_face),
        another,
        np.flatnonzero(~alive),
        tuple(named[number] for number in numbers.tolist()),
        mm,
        take.rate if take.rate > 0 else USUAL_RATE,
    )


def living_labels(take: Take) -> Ints:
    """Return the numbers of the labels that are ever seen.

    Raises :class:`InputError` ``markers.too_large`` for more of them than a face has: what takes a
    take apart compares all of them with each other.
    """
    alive = np.flatnonzero(np.isfinite(take.positions[..., 0]).any(axis=0))
    if len(alive) > FACE.most:
        message = f"{take.file} has {len(alive)} markers, {FACE.most} can be bound"
        figures = {"found": len(alive), "expected": FACE.most}
        raise InputError("markers.too_large", message, file=take.file, **figures)
    return alive


def count_tracks(take: Take) -> Take:
    """Return a take without labels with its tracks as such; others as they are."""
    if len(take.labels) >= FACE.least or not take.unlabelled_names:
        return take
    positions = np.concatenate([take.positions, take.unlabelled], axis=1)
    labels = (*take.labels, *take.unlabelled_names)
    return replace(take, positions=positions, labels=labels, unlabelled_names=())


def _largest_face(positions: Floats, chosen: Mask) -> tuple[Mask, Ints]:
    """Return which of the ``chosen`` markers (f, k, 3) are on one face, and those of a second."""
    numbers = np.flatnonzero(chosen)
    if len(numbers) < FACE.least:
        return chosen, numbers[:0]
    apart = np.nan_to_num(_usual_distances(positions[:, numbers]), nan=np.inf)
    _, group = connected_components(apart < FACE.linked)
    sizes = np.bincount(group)
    order = np.argsort(-sizes, kind="stable")
    on_face = np.zeros(len(chosen), bool)
    on_face[numbers[group == order[0]]] = True
    least = max(FACE.second * sizes[order[0]], FACE.least_second)
    is_another = len(order) > 1 and sizes[order[1]] >= least
    return on_face, numbers[group == order[1]] if is_another else numbers[:0]


def _neighbours_unit(positions: Floats) -> float:
    """Return the mm a unit that puts neighbours as far apart as on a face; 1 if that does."""
    if positions.shape[1] < FACE.least:
        return 1.0
    apart = np.nan_to_num(_usual_distances(positions), nan=np.inf)
    np.fill_diagonal(apart, np.inf)
    spacing = float(np.median(np.sort(apart, axis=1)[:, 1]))  # the second: labels may be double
    return likely_unit(spacing, FACE.spacing, (1.0, 1000.0, 10.0, 0.1, 0.001)) or 1.0


def _unit_by_names(take: Take, on_face: Mask, named: Sequence[Named | None]) -> float | None:
    """Return the mm a unit that puts a face's markers as far apart as their names; None if none."""
    places = {
        number: each.place
        for number, each in enumerate(named)
        if each is not None and each.part == "face" and on_face[number]
    }
    if len(places) < FACE.least:
        return None
    apart = _usual_distances(take.positions[:, list(places)])
    at = np.array(list(places.values()))
    by_name = np.linalg.norm(at[:, None] - at[None], axis=2)
    known = (by_name > 0) & (apart > 0)
    if not known.any():
        return None
    scale = float(np.median(by_name[known] / apart[known]))
    unit = choose_unit(scale, None, None, NAMES_UNIT, read_mm=take.unit_mm)
    return None if unit.source == "template" else unit.mm_per_unit


def _usual_distances(positions: Floats, frames: int = 40) -> Floats:
    """Return the median distances (k, k) of markers, NaN for those never seen together."""
    some = positions[np.unique(np.linspace(0, len(positions) - 1, frames).astype(int))]
    return median_of_seen(
        np.array([np.linalg.norm(each[:, None] - each[None], axis=2) for each in some])
    )


def locate_take(
    face: FaceMarkers,
    skin: Surface,
    neutral: tuple[int, int] | None = None,
    *,
    compared: bool = True,
) -> LocatedTake:
    """Return where a face's markers lie on a ``skin``, at rest in the ``neutral`` rows.

    Without these the likeliest rest is taken, or of the few likeliest that are ``compared`` that in
    which the markers lie most like the skin.
    """
    faults = find_faults(face.mm * face.take.positions[:, face.numbers], face.rate)
    if neutral:
        return _locate_at(face, skin, faults, neutral)
    rests = likely_rests(faults, face.names, face.rate)
    found = [_locate_at(face, skin, faults, rests[0].rows)]
    # markers that are no face at rest are none in other poses either: they take long to look for
    if compared and not _lies_elsewhere(found[0].pose):
        found += [_locate_at(face, skin, faults, each.rows) for each in rests[1:]]
    tried = rests[: len(found)]
    unlike = [_unlikeness(each.pose) for each in found]
    costs = [each.second.unrest + miss for each, miss in zip(tried, unlike, strict=True)]
    best = int(np.argmin(costs))
    others = rivals(rests[best], rests)
    if len(found) == len(rests):
        much = unlike[best] + FACE.resembles
        others = [each for each in others if unlike[rests.index(each)] < much]
    return replace(found[best], rest=rests[best], rival=others[0] if others else None)


def _locate_at(
    face: FaceMarkers, skin: Surface, faults: Faults, rows: tuple[int, int]
) -> LocatedTake:
    """Return where a face's markers lie on a ``skin``, at rest in some rows."""
    points = _rest_points(faults.motion, rows) / face.mm
    here = LocatedTake(face, faults, rows, points, None)
    if here.distinct < FACE.least:
        return here
    return replace(here, pose=locate(points, face.names, skin, read_mm=face.take.unit_mm))


def _unlikeness(pose: Located | None) -> float:
    """Return how far markers miss the skin at their usual height, mm, infinite without a pose."""
    if pose is None or not np.isfinite(pose.off_skin).any():
        return np.inf
    return float(np.nanmean(np.minimum(np.abs(pose.off_skin), LOCATE.off_skin)))


def _lies_elsewhere(pose: Located | None) -> bool:
    """Return whether so few of the markers that are seen are on the skin that they are no face."""
    if pose is None:
        return False
    off = pose.off_skin[np.isfinite(pose.off_skin)]
    return bool((np.abs(off) <= LOCATE.off_skin).sum() < FACE.least_on * len(off))


def frames_about(
    take: Take, frame: int | None, rate: float = 0.0, seconds: float = 0.5
) -> tuple[int, int] | None:
    """Return first and last row of half a second about the frame with a number; None for None.

    ``rate`` is that of a take which has none. Raises :class:`InputError` ``markers.neutral`` if
    the take does not have the frame.
    """
    if frame is None:
        return None
    numbers = take.numbers
    if frame not in numbers:
        message = f"{take.file} has frames {numbers[0]} to {numbers[-1]}, not {frame}"
        raise InputError("markers.neutral", message, file=take.file, frame=frame)
    a_second = take.rate if take.rate > 0 else rate or USUAL_RATE
    row = numbers.index(frame)
    reach = round(seconds / 2 * a_second)
    return max(row - reach, 0), min(row + reach, len(take) - 1)


def _rest_points(motion: Motion, neutral: tuple[int, int]) -> Floats:
    """Return markers (k, 3) at rest, in the axes of the take, as the head is amid ``neutral``."""
    first, last = neutral
    middle = (first + last) // 2
    points = median_of_seen(motion.places[first : last + 1])
    return np.asarray((points - motion.shifts[middle]) @ motion.rotations[middle])
