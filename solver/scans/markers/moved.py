"""Markers that moved within a take: a label and a place of its own for each span.

A marker that fell off and was glued on beside its place is another marker from then on. How far it
went is what its residuals (``motion.py``) differ by before and after.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solver.scans.markers.bind import place_on, places_of
from solver.scans.markers.faults import Faults
from solver.scans.markers.marker_set import Marker, MarkerSet, span_label
from solver.scans.markers.motion import Motion, median_of_seen
from solver.scans.markers.take import Take
from solver.similarity import robust_motion_of_seen
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class SplitOptions:
    """Settings of the motion of a take's middle face onto a set's places."""

    least: int = 4  # markers that give it
    slack_mm: float = 3.0  # off by more: little weight
    steps: int = 12


def split_moved(
    take: Take,
    markers: MarkerSet,
    faults: Faults,
    skin: Surface,
    options: SplitOptions = SplitOptions(),
) -> tuple[Take, MarkerSet]:
    """Give each marker that moved a label and a place of its own from then on, as ``LBRO1@312``.

    ``faults`` are of all labels of the take. The place in the set is of the span that lies nearer.
    Places of markers that moved in other takes are left out.
    """
    markers = markers.for_take(take.labels)
    if not faults.moved:
        return take, markers
    goal = places_of(take.labels, markers, skin)
    in_person = _in_person(faults.motion, markers, goal, options)
    labels, columns, now = list(take.labels), list(range(len(take.labels))), list(markers.markers)
    positions = take.positions.copy()
    for column, span in faults.moved.items():
        if in_person is None or np.isnan(goal[column, 0]):
            continue
        first, row = span.first, markers.labels.index(labels[column])
        places, residuals = in_person[0][:, column], in_person[1][:, column]
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


def _in_person(
    motion: Motion, markers: MarkerSet, goal: Floats, options: SplitOptions
) -> tuple[Floats, Floats] | None:
    """Return places and residuals (f, k, 3) along the person's axes, by its places (k, 3) at rest.

    None if too few markers have a place.
    """
    turn = markers.session.rotation.T  # it mirrors if the take's axes are left-handed
    middle = motion.middle @ turn
    least, slack = options.least, options.slack_mm
    to_person = robust_motion_of_seen(middle, goal, slack, options.steps, least)
    if to_person is None:
        return None
    return to_person(motion.places @ turn), to_person.turn(motion.residuals @ turn)


def _move_to(marker: Marker, place: Floats, skin: Surface) -> Marker:
    """Return a marker at another place: of the skin, or on its bone."""
    if marker.part == "face":
        return place_on(marker, place, skin)
    x, y, z = place.tolist()
    return replace(marker, place_mm=(x, y, z))
