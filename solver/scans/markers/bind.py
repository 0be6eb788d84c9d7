"""Where the markers of a take sit on a person: the marker set of a session.

The take's face at rest is found on the person (``locate.py``); each marker is then bound where it
lies: to the skin with a height over it, or to the bone that it rides on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from solver.anatomy.embedding import barycentric
from solver.errors import InputError
from solver.model import SubjectModel
from solver.scans.markers.locate import Located, heights_over, locate, nose_tip
from solver.scans.markers.marker_set import Marker, MarkerSet, Triple
from solver.scans.markers.motion import Motion, median_of_seen, take_apart
from solver.scans.markers.names import Named, read_names
from solver.scans.markers.take import Take
from solver.surface import Floats, Surface, unit_rows, vertex_normals

USUAL_RATE = 60.0  # frames a second, where a take does not say


@dataclass(frozen=True)
class BindOptions:
    """What a marker is bound to; lengths in mm."""

    most: int = 400  # markers: pairs of them are compared
    least: int = 4  # labels; with fewer, tracks without one count as such
    spacing: tuple[float, float] = (6.0, 90.0)  # of neighbours on a face
    off_skin: float = 15.0  # farther from the skin it is no marker of the face ...
    above: float = 45.0  # ... but of the head, if it is so far above the nose's tip ...
    of_head: float = 260.0  # ... and no farther from it than this
    sigma: float = 1.0  # of a place by the nearest point of the skin
    bony_sigma: float = 0.5


@dataclass(frozen=True)
class Binding:
    """A marker set for a take, and how it was come by."""

    markers: MarkerSet
    located: Located
    neutral: tuple[int, int]  # first and last frame, from 0


def bind(
    take: Take,
    model: SubjectModel,
    neutral: tuple[int, int] | None = None,
    options: BindOptions = BindOptions(),
) -> Binding:
    """Return where the markers of a take sit on ``model``, at rest in the ``neutral`` frames.

    Without these the stillest second is taken. Raises :class:`InputError` ``markers.few``: not
    enough of them are seen in these frames.
    """
    take = count_tracks(take)
    if len(take.labels) > options.most:
        raise crowded_error(take.file, len(take.labels), options.most)
    mm = rough_unit(take.positions)
    motion = take_apart(mm * take.positions, take.rate if take.rate > 0 else USUAL_RATE)
    first, last = neutral or find_neutral(motion, take.rate)
    points = rest_points(motion, (first, last)) / mm
    named = tuple(read_names(take.labels))
    located = locate(points, named, model_face(model))
    if located is None:
        seen = int(np.isfinite(points[:, 0]).sum())
        message = f"{take.file}: {seen} markers are seen at rest, {options.least} are needed"
        raise InputError("markers.few", message, file=take.file, found=seen)
    placed = located.session(points)
    markers = place_markers(take.labels, named, placed, model_face(model), options)
    bound = MarkerSet(markers, located.session, model.sha256)
    return Binding(bound, located, (first, last))


def count_tracks(take: Take, options: BindOptions = BindOptions()) -> Take:
    """Return a take without labels with its tracks as such; others as they are."""
    if len(take.labels) >= options.least or not take.unlabelled_names:
        return take
    positions = np.concatenate([take.positions, take.unlabelled], axis=1)
    labels = (*take.labels, *take.unlabelled_names)
    return replace(take, positions=positions, labels=labels, unlabelled_names=())


def crowded_error(file: str, count: int, most: int) -> InputError:
    """Return the error of a take with more markers than a face has."""
    message = f"{file} has {count} markers, {most} can be bound"
    return InputError("markers.too_large", message, file=file, found=count, expected=most)


def rough_unit(positions: Floats, options: BindOptions = BindOptions()) -> float:
    """Return the mm a unit that puts neighbours as far apart as on a face; 1 if that does."""
    if positions.shape[1] < options.least:
        return 1.0
    apart = np.nan_to_num(usual_distances(positions), nan=np.inf)
    np.fill_diagonal(apart, np.inf)
    spacing = float(np.median(np.sort(apart, axis=1)[:, 1]))  # the second: labels may be double
    low, high = options.spacing
    return next((mm for mm in (1.0, 1000.0, 10.0, 0.1, 0.001) if low <= mm * spacing <= high), 1.0)


def usual_distances(positions: Floats, frames: int = 40) -> Floats:
    """Return the median distances (k, k) of markers, NaN for those never seen together."""
    some = positions[np.unique(np.linspace(0, len(positions) - 1, frames).astype(int))]
    apart = np.array([np.linalg.norm(each[:, None] - each[None], axis=2) for each in some])
    return median_of_seen(apart)


def frames_about(take: Take, frame: int | None, seconds: float = 0.5) -> tuple[int, int] | None:
    """Return the frames, from 0, of half a second about ``frame``, as the file counts.

    Raises :class:`InputError` ``markers.neutral`` if the take does not have it.
    """
    if frame is None:
        return None
    numbers = take.numbers
    if frame not in numbers:
        message = f"{take.file} has frames {numbers[0]} to {numbers[-1]}, not {frame}"
        raise InputError("markers.neutral", message, file=take.file, frame=frame)
    row, reach = numbers.index(frame), round(seconds / 2 * take.rate) if take.rate > 0 else 0
    return max(row - reach, 0), min(row + reach, len(take) - 1)


def model_face(model: SubjectModel) -> Surface:
    """Return the part of a person's skin that markers sit on, in the numbers of the whole skin."""
    is_face = np.zeros(len(model.skin.vertices), bool)
    is_face[model.face] = True
    return Surface(model.skin.vertices, model.skin.faces[is_face[model.skin.faces].all(axis=1)])


def rest_points(motion: Motion, neutral: tuple[int, int]) -> Floats:
    """Return markers (k, 3) at rest, in the axes of the take, as the head is amid ``neutral``."""
    first, last = neutral
    middle = (first + last) // 2
    points = median_of_seen(motion.places[first : last + 1])
    return np.asarray((points - motion.shifts[middle]) @ motion.rotations[middle])


@dataclass(frozen=True)
class NeutralOptions:
    """What makes frames a neutral; lengths in mm."""

    seconds: float = 1.0
    away: float = 0.05  # of unrest that a mm away from the median face counts as
    seen: float = 0.8  # of the most markers must be seen


def find_neutral(
    motion: Motion, rate: float, options: NeutralOptions = NeutralOptions()
) -> tuple[int, int]:
    """Return first and last frame of the second in which the face is stillest.

    Of two that are equally still it is the one nearer to the median face.
    """
    frames = len(motion.places)
    window = int(np.clip(round(options.seconds * rate) if rate > 0 else 1, 1, frames))
    seen = np.isfinite(motion.places[..., 0])
    moved = np.nan_to_num(motion.places - motion.middle)
    count = np.maximum(_sums(seen.astype(float), window), 1.0)
    mean = _sums(moved, window) / count[..., None]
    unrest = np.maximum(_sums((moved**2).sum(axis=2), window) / count - (mean**2).sum(axis=2), 0.0)
    away = np.linalg.norm(mean, axis=2)
    known = np.maximum((count > window / 2).sum(axis=1), 1)
    cost = np.sqrt((unrest * (count > window / 2)).sum(axis=1) / known)
    cost += options.away * (away * (count > window / 2)).sum(axis=1) / known
    cost[known < options.seen * known.max()] = np.inf
    first = int(np.argmin(cost))
    return first, first + window - 1


def _sums(values: Floats, window: int) -> Floats:
    """Return sums over ``window`` frames, for every frame that has so many from it on."""
    total = np.cumsum(np.concatenate([np.zeros((1, *values.shape[1:])), values]), axis=0)
    return np.asarray(total[window:] - total[:-window])


def place_markers(
    labels: Sequence[str],
    named: Sequence[Named | None],
    placed: Floats,
    face: Surface,
    options: BindOptions = BindOptions(),
) -> tuple[Marker, ...]:
    """Return a marker for every label that is seen, on the skin, on a bone, or to be ignored."""
    seen = np.flatnonzero(np.isfinite(placed[:, 0]))
    triangles, shares, _ = barycentric(placed[seen], face)
    heights, corners = heights_over(placed[seen], face), face.faces[triangles]
    shares = np.clip(shares, 0.0, 1.0)
    shares /= shares.sum(axis=1, keepdims=True)
    tip = nose_tip(face)
    found = []
    for row, number in enumerate(seen.tolist()):
        said, at = named[number], placed[number]
        part = "face" if said is None else said.part
        if part == "face" and abs(heights[row]) > options.off_skin:
            near = np.linalg.norm(at - tip) < options.of_head and at[1] - tip[1] > options.above
            part = "head" if near else "ignore"
        if part == "face":
            vertices = tuple(corners[row].tolist())
            weights = tuple(shares[row].tolist())
            found.append(
                Marker(
                    labels[number], vertices, weights, float(heights[row]), sigma_mm=options.sigma
                )
            )
        else:
            at_bone: Triple = (float(at[0]), float(at[1]), float(at[2]))
            found.append(
                Marker(labels[number], part=part, sigma_mm=options.bony_sigma, place_mm=at_bone)
            )
    return tuple(found)


def rest_places(markers: MarkerSet, skin: Surface) -> Floats:
    """Return where markers (k, 3) lie on a person at rest, in the model's frame.

    Those that are to be ignored, and have no place, are NaN.
    """
    normals = vertex_normals(skin)[markers.vertices]
    outward = unit_rows(np.einsum("kc,kcd->kd", markers.weights, normals))
    on_skin = np.einsum("kc,kcd->kd", markers.weights, skin.vertices[markers.vertices])
    is_face = np.array([each.part == "face" for each in markers.markers], bool)
    raised = on_skin + markers.heights[:, None] * outward
    return np.where(is_face[:, None], raised, markers.places)
