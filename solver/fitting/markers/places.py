"""Mend a marker set by the frames of a take: places and heights, solved with the activations.

A marker that is bound beside where it is leaves the same offset in every frame, in the axes of its
triangle; what the face does differs from frame to frame. So its place moves by the median offset,
shrunk by how well that is known: b s^2 / (s^2 + v / n), for the offset b with the spread v over n
frames and the binding's own spread s. It never moves far from where it was bound.

The frames are those nearest the neutral face: there the model errs least, and what it errs in an
expression would be taken for an offset of the markers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from solver.fitting.face import Face
from solver.fitting.least_squares import StopOptions
from solver.fitting.markers.observation import MarkerOptions, Markers, SeenMarkers
from solver.fitting.markers.term import HeadOptions, HeadPrior, MarkerPlaces
from solver.fitting.prior import GaussianPrior
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.frame_solver import TrackingOptions
from solver.scans.markers.places.bind import model_face, place_on
from solver.scans.markers.places.marker_set import Marker
from solver.scans.markers.signal.motion import rms_of_seen
from solver.surface import Floats, unit_rows


@dataclass(frozen=True)
class RefineOptions:
    """Choice of frames, rounds, and how far a place may move."""

    candidates: int = 1000  # frames of the take, evenly, among which the nearest to neutral are ...
    apart: int = 5  # ... chosen, so many candidates or more between them
    # of a frame that is compared with the neutral face: closer than where expressions are fitted
    head: HeadOptions = field(
        default_factory=lambda: HeadOptions(placed_within_mm=4.0, placings=10)
    )
    least_seen: float = 0.5  # of the markers, in a frame that is chosen
    rounds: int = 4
    most_mm: float = 5.0  # from where a marker was bound
    least_frames: int = 5  # in which a marker counts, or it stays
    tracking: MarkerOptions = field(default_factory=MarkerOptions)  # of the take
    # of a frame, in place of the take's: the next lies far away
    steps: TrackingOptions = field(
        default_factory=lambda: TrackingOptions(StopOptions(10, promised=2e-3), secants=None)
    )


def frames_near_neutral(
    places: Floats,
    frame: Callable[[int], Floats],
    frames: range,
    count: int,
    options: RefineOptions = RefineOptions(),
) -> list[int]:
    """Choose ``count`` of a take's frames whose markers are nearest those of the neutral face.

    ``places`` (k, 3) are the markers' at rest, ``frame`` gives the points (k, 3) of one of the
    take's ``frames``. Fewer are chosen of a short take, in their order.
    """
    rows = np.unique(np.linspace(0, len(frames) - 1, options.candidates).round().astype(int))
    numbers = np.array(frames)[rows]
    away = [_off_neutral(places, frame(number), options) for number in numbers.tolist()]
    apart = min(options.apart, len(numbers) // (2 * count))
    chosen: list[int] = []
    for candidate in np.argsort(away, kind="stable").tolist():
        if len(chosen) == count or not np.isfinite(away[candidate]):
            break
        if all(abs(candidate - other) > apart for other in chosen):
            chosen.append(candidate)
    return sorted(numbers[chosen].tolist())


def _off_neutral(places: Floats, seen: Floats, options: RefineOptions) -> float:
    """Return the rms distance from the neutral face, mm; infinite where few markers are seen."""
    known = np.isfinite(seen).all(axis=1)
    if known.sum() < max(options.least_seen * len(places), 3.0):
        return np.inf
    head = HeadPrior.of_most(places, seen, np.ones(len(places)), options.head)
    return rms_of_seen(np.linalg.norm(head.motion(places) - seen, axis=1))


def refine_by_take(
    face: Face,
    markers: Sequence[Marker],
    prior: GaussianPrior,
    frame: Callable[[int], Floats],
    frames: range,
    seconds: float,
    count: int,
    options: RefineOptions = RefineOptions(),
) -> tuple[Marker, ...]:
    """Return the markers moved by the ``count`` frames of a take nearest the neutral face.

    ``frame`` gives the points (k, 3) in mm of one of ``frames``, which are ``seconds`` apart.
    """
    at = MarkerPlaces(face.model, markers).at(face.model.rest)
    chosen = frames_near_neutral(at, frame, frames, count, options)
    apart = len(frames) * seconds / max(len(chosen), 1)
    return refine(face, markers, prior, [frame(number) for number in chosen], apart, options)


def refine(
    face: Face,
    markers: Sequence[Marker],
    prior: GaussianPrior,
    frames: Sequence[Floats],
    seconds: float,
    options: RefineOptions = RefineOptions(),
) -> tuple[Marker, ...]:
    """Return the markers moved by what ``frames`` (k, 3) in mm say of them.

    The frames are ``seconds`` apart (:func:`frames_near_neutral`). Markers on bones stay.
    """
    steps = replace(options.steps, whole=options.tracking.tracking.whole)
    tracking = replace(options.tracking, tracking=steps)
    rest = face.model.rest
    now = list(markers)
    skin = model_face(face.model)
    bound = MarkerPlaces(face.model, markers).at(rest)
    for _ in range(options.rounds):
        places = MarkerPlaces(face.model, now)
        sigma = np.array([marker.sigma_mm for marker in now])
        offsets = _offsets(Markers(face, places, sigma, prior, seconds, tracking), frames)
        counts = np.isfinite(offsets[..., 0]).sum(axis=0)
        axes = triangle_axes(places.corners(rest))
        at = places.at(rest)
        for number, marker in enumerate(now):
            count = int(counts[number])
            if count < options.least_frames or marker.place_mm is not None:
                continue
            mine = offsets[:, number][np.isfinite(offsets[:, number, 0])]
            trusted = marker.sigma_mm**2 / (marker.sigma_mm**2 + mine.var(axis=0) / count)
            goal = at[number] + axes[number] @ (trusted * np.median(mine, axis=0))
            away = goal - bound[number]
            away *= min(1.0, options.most_mm / max(float(np.linalg.norm(away)), 1e-9))
            now[number] = place_on(marker, bound[number] + away, skin)
    return tuple(now)


def _offsets(markers: Markers, frames: Sequence[Floats]) -> Floats:
    """Return what is left of frames (f, k, 3) in the axes of triangles, NaN where nothing is."""
    found = []
    tracker = Tracker(markers)
    for seen in frames:
        fit = tracker.step(SeenMarkers(seen))
        if fit.kept:
            continue
        off = (fit.judged.points - fit.placed.points) @ fit.placed.head.rotation
        axes = triangle_axes(markers.places.corners(fit.state.x))
        local = np.einsum("kij,ki->kj", axes, off)
        found.append(np.where(fit.judged.weights[:, None] > 0.0, local, np.nan))
    return np.reshape(found, (-1, len(markers.places), 3))


def triangle_axes(corners: Floats) -> Floats:
    """Return axes (k, 3, 3), as columns: along a triangle's first edge, across it, its normal."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    normal = unit_rows(np.cross(first, second))
    along = unit_rows(first)
    return np.stack([along, np.cross(normal, along), normal], axis=2)
