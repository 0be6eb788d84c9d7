"""Where a take's markers sit on a person: by their names, by the face's shape, then on the skin.

Names give the direction of the face, its unit, and whether left and right are where they should
be; without them the markers' own shape is looked for on the face, as a face is in a scan. Either
way they slide onto the skin, with a height of their own over it, and each is bound where it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from solver.anatomy.embedding import barycentric
from solver.errors import InputError
from solver.model import SubjectModel
from solver.registration.scan_surface import Samples, sample
from solver.registration.search import FacePoints, RefinementOptions, find_pose, refine_pose
from solver.registration.units import UNITS, ScanUnit, UnitOptions, choose_unit
from solver.scans.markers.marker_set import Marker, MarkerSet, Triple
from solver.scans.markers.motion import Mask, Motion, take_apart
from solver.scans.markers.names import Named, read_names
from solver.scans.markers.take import Take
from solver.similarity import Similarity, fit_similarity, robust_motion
from solver.surface import Floats, Surface, nearest_sphere, unit_rows, vertex_normals

FLIP = np.diag([-1.0, 1.0, 1.0])
LOWER = frozenset({"chin", "jaw", "lower_lip", "lower_teeth"})  # regions that the jaw opens
# Names give a size roughly, but units are far apart.
NAMES_UNIT = UnitOptions(face_sizes=(0.65, 1.5), unusual=0.35)


@dataclass(frozen=True)
class BindOptions:
    """How markers find their place; lengths in mm."""

    least: int = 4  # markers that say where a face is
    trims: int = 5  # rounds in which names that fit badly lose their say
    kept: float = 2.0  # times the median misfit of names: what counts
    name_misfit: float = 22.0  # of most names; with more the shape is looked for
    mirrored: float = 0.6  # of the misfit: sides the other way round fit that much better
    exchanged: float = 800.0  # mm2 that two names gain by changing places
    samples: int = 20_000  # points of the skin
    heights: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0)  # of markers over the skin
    flat: float = 0.1  # heights whose misfits differ by less cannot be told: the usual is taken
    usual_height: float = 2.0
    rounds: int = 3  # of normals and motion
    extents: tuple[float, float] = (60.0, 420.0)  # of the markers of one head
    off_skin: float = 15.0  # farther from the skin it is no marker of the face ...
    above: float = 45.0  # ... but of the head, if it is so far above the nose's tip ...
    of_head: float = 260.0  # ... and no farther from it than this
    sigma: float = 1.0  # of a place by the nearest point of the skin
    bony_sigma: float = 0.5


@dataclass(frozen=True)
class Located:
    """The face under markers, in their own axes and unit."""

    session: Similarity  # takes the markers to the face's frame; it mirrors if ``mirrored``
    unit: ScanUnit
    by_names: bool  # or by the markers' shape
    mirrored: bool
    sides_exchanged: bool  # all left labels lie on the right, as the face is not mirrored
    exchanged: tuple[tuple[int, int], ...]  # markers that lie where the other should by its name
    height_mm: float  # of most over the skin
    off_skin: Floats  # (k,) farther from the skin than that, in mm; NaN where not seen

    def miss(self, which: Mask | None = None) -> float:
        """Return the rms of how far markers miss the skin at that height, in mm."""
        off = self.off_skin if which is None else self.off_skin[which]
        known = off[np.isfinite(off)]
        return float(np.sqrt((known**2).mean())) if len(known) else 0.0


@dataclass(frozen=True)
class Binding:
    """A marker set for a take, and how it was come by."""

    markers: MarkerSet
    located: Located
    neutral: tuple[int, int]  # first and last frame, from 0
    points: Floats  # (k, 3) in the model's frame, NaN where a marker is not seen there
    named: tuple[Named | None, ...] = field(default=())


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
    motion = take_apart(take.positions, take.rate if take.rate > 0 else 60.0)
    first, last = neutral or find_neutral(motion, take.rate)
    points = rest_points(motion, (first, last))
    named = tuple(read_names(take.labels))
    located = locate(points, named, model_face(model), options)
    if located is None:
        seen = int(np.isfinite(points[:, 0]).sum())
        message = f"{take.file}: {seen} markers are seen at rest, {options.least} are needed"
        raise InputError("markers.few", message, file=take.file, found=seen)
    placed = located.session(points)
    markers = place_markers(take.labels, named, placed, model_face(model), options)
    bound = MarkerSet(markers, located.session, model.sha256)
    return Binding(bound, located, (first, last), placed, named)


def frames_about(take: Take, frame: int | None, seconds: float = 0.5) -> tuple[int, int] | None:
    """Return the frames, from 0, of half a second about ``frame``, as the file counts.

    Raises :class:`InputError` ``markers.neutral`` if the take does not have it.
    """
    if frame is None:
        return None
    number, last = frame - take.first, len(take) - 1
    if not 0 <= number <= last:
        message = f"{take.file} has frames {take.first} to {take.first + last}, not {frame}"
        raise InputError("markers.neutral", message, file=take.file, frame=frame)
    reach = round(seconds / 2 * take.rate) if take.rate > 0 else 0
    return max(number - reach, 0), min(number + reach, last)


def model_face(model: SubjectModel) -> Surface:
    """Return the part of a person's skin that markers sit on, in the numbers of the whole skin."""
    is_face = np.zeros(len(model.skin.vertices), bool)
    is_face[model.face] = True
    return Surface(model.skin.vertices, model.skin.faces[is_face[model.skin.faces].all(axis=1)])


def rest_points(motion: Motion, neutral: tuple[int, int]) -> Floats:
    """Return markers (k, 3) at rest, in the axes of the take, as the head is amid ``neutral``."""
    first, last = neutral
    middle = (first + last) // 2
    there = motion.places[first : last + 1]
    points = np.full(there.shape[1:], np.nan)
    seen = np.isfinite(there[..., 0]).any(axis=0)
    points[seen] = np.nanmedian(there[:, seen], axis=0)
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


# Where the face is under markers.


def locate(
    points: Floats,
    named: Sequence[Named | None],
    face: Surface,
    options: BindOptions = BindOptions(),
) -> Located | None:
    """Return where ``face`` lies under markers (k, 3), NaN where not seen; None if they are few."""
    seen = np.isfinite(points[:, 0])
    may_be = np.array([each is None or each.part == "face" for each in named], bool)
    used = np.flatnonzero(seen & may_be)
    if len(used) < options.least:
        return None
    skin = sample(face.vertices, face.faces, None, options.samples)
    by_names = _by_names(points, named, face, options)
    if by_names is not None:
        starts, turned = by_names
        unit = choose_unit(starts[0].scale, None, None, NAMES_UNIT)
    else:
        unit, turned = _unit_of(points[used], options), False
        starts = _by_shape(points[used], skin, unit.mm_per_unit)
    found = [_slide(start, unit, points, used, face, skin, options) for start in starts]
    chosen = found[0]
    if len(found) > 1:  # a mirrored face, or sides exchanged: the first, unless it fits worse
        chosen = min(found, key=lambda each: each.miss() + 0.15 * found[0].miss() * (each is not found[0]))
    chosen = replace(
        chosen,
        by_names=by_names is not None,
        sides_exchanged=turned and not chosen.mirrored,
    )
    if by_names is None or turned:
        return chosen
    return replace(chosen, exchanged=_exchanged(chosen, points, named, face, options))


def _by_names(
    points: Floats, named: Sequence[Named | None], face: Surface, options: BindOptions
) -> tuple[list[Similarity], bool] | None:
    """Return motions onto the face by names, and whether sides are the wrong way round.

    None if names do not say it. Either the markers are mirrored then, or the labels are: the
    motions of both come back.
    """
    told = [n for n, each in enumerate(named) if each is not None and each.part == "face"]
    told = [number for number in told if np.isfinite(points[number, 0])]
    places = {number: each.place for number, each in enumerate(named) if each is not None}
    if len(told) < options.least or len({places[number] for number in told}) < options.least:
        return None
    goal = np.array([places[number] for number in told], float) + nose_tip(face)
    plain, misfit = _trimmed(points[told], goal, options)
    other, other_misfit = _trimmed(points[told] @ FLIP, goal, options)
    turned = other_misfit < options.mirrored * misfit
    if min(misfit, other_misfit) > options.name_misfit:
        return None
    if not turned:
        return [plain], False
    across = (goal - nose_tip(face)) @ FLIP + nose_tip(face)
    return [_flipped(other), _trimmed(points[told], across, options)[0]], True


def nose_tip(face: Surface) -> Floats:
    """Return the foremost point (3,) of a face."""
    used = face.vertices[np.unique(face.faces)]
    return np.asarray(used[np.argmax(used[:, 2])])


def _flipped(motion: Similarity) -> Similarity:
    """Return a motion of mirrored points as one of the points."""
    return Similarity(motion.scale, motion.rotation @ FLIP, motion.shift)


def _trimmed(points: Floats, goal: Floats, options: BindOptions) -> tuple[Similarity, float]:
    """Return the motion that most points agree with, and the median misfit in mm."""
    kept = np.ones(len(points), bool)
    motion, off = fit_similarity(points, goal), np.zeros(len(points))
    for _ in range(options.trims):
        off = np.linalg.norm(motion(points) - goal, axis=1)
        closer = off <= max(options.kept * float(np.median(off)), 1.0)
        if closer.sum() < options.least or (closer == kept).all():
            break
        kept = closer
        motion = fit_similarity(points[kept], goal[kept])
    return motion, float(np.median(off))


def _unit_of(points: Floats, options: BindOptions) -> ScanUnit:
    """Return the unit that makes markers as large as those of a head; mm if it does."""
    extent = float(np.ptp(points, axis=0).max())
    low, high = options.extents
    fitting = [mm for mm in (1.0, *UNITS.values()) if low <= mm * extent <= high]
    if fitting:
        return ScanUnit(fitting[0], "assumed" if fitting[0] == 1.0 else "found")
    return ScanUnit(180.0 / max(extent, 1e-9), "template")


def _by_shape(points: Floats, skin: Samples, mm_per_unit: float) -> list[Similarity]:
    """Return motions of markers and of their mirror image onto the face, by their shape alone."""
    found = []
    for flip in (np.eye(3), FLIP):
        placed = mm_per_unit * points @ flip
        centre, _ = nearest_sphere(placed)
        outward = unit_rows(placed - centre)
        tip = int(np.argmax(np.linalg.norm(placed - centre, axis=1)))
        forward = unit_rows(outward.mean(axis=0))
        cloud = FacePoints(placed, outward, placed[tip], forward)
        motion = find_pose(cloud, skin, [1.0]).motion.inverse()
        found.append(Similarity(mm_per_unit * motion.scale, motion.rotation @ flip, motion.shift))
    return found


def _slide(
    start: Similarity,
    unit: ScanUnit,
    points: Floats,
    used: np.ndarray,
    face: Surface,
    skin: Samples,
    options: BindOptions,
) -> Located:
    """Return ``start`` after its markers slid onto the skin, all at one height over it."""
    size = start.scale if unit.source == "template" else unit.mm_per_unit
    rough = start(points[used])
    begin = robust_motion(points[used] * size @ _hand(start), rough, np.ones(len(used)), 10.0, 3)
    begin = Similarity(size, begin.rotation @ _hand(start), begin.shift)
    tries = []
    for height in options.heights:
        raised = Samples(skin.points + height * skin.normals, skin.normals, True)
        session = _onto(begin, points[used], raised, options)
        over = _heights(session(points[used]), face) - height
        over = np.where(np.abs(over) > options.off_skin, np.nan, over)
        tries.append((float(np.sqrt(np.nanmedian(over**2))), height, session))
    least = min(miss for miss, _, _ in tries)
    alike = [each for each in tries if each[0] <= least + options.flat]
    _, height, session = min(alike, key=lambda each: abs(each[1] - options.usual_height))
    off = np.full(len(points), np.nan)
    off[used] = _heights(session(points[used]), face) - height
    mirrored = bool(np.linalg.det(session.rotation) < 0)
    return Located(session, unit, False, mirrored, False, (), height, off)


def _hand(motion: Similarity) -> Floats:
    return FLIP if np.linalg.det(motion.rotation) < 0 else np.eye(3)


def _onto(start: Similarity, points: Floats, skin: Samples, options: BindOptions) -> Similarity:
    """Return the motion after the markers slid onto the skin; the size stays."""
    tree, session = KDTree(skin.points), start
    stiff = RefinementOptions(
        kept=0.85, sizes=(1.0, 1.0), least_points=options.least, close=options.off_skin, still=0.01
    )
    for _ in range(options.rounds):
        placed = session(points)
        normals = skin.normals[tree.query(placed)[1]]
        cloud = FacePoints(placed, normals, placed[0], normals[0])
        back = refine_pose(cloud, skin, tree, Similarity(1.0, np.eye(3), np.zeros(3)), 1.0, stiff)
        session = session.then(back.motion.inverse())
    return session


def _heights(placed: Floats, face: Surface) -> Floats:
    """Return how far (n,) points lie over a face, below 0 inside of it."""
    triangles, shares, distance = barycentric(placed, face)
    corners = face.vertices[face.faces[triangles]]
    nearest = np.einsum("nc,ncd->nd", shares, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("nd,nd->n", placed - nearest, normals)
    return np.asarray(distance * np.sign(outward + 1e-30))


def _exchanged(
    located: Located,
    points: Floats,
    named: Sequence[Named | None],
    face: Surface,
    options: BindOptions,
) -> tuple[tuple[int, int], ...]:
    """Return pairs of markers that lie where the other should by its name."""
    told = [n for n, each in enumerate(named) if each is not None and each.part == "face"]
    told = [number for number in told if np.isfinite(points[number, 0])]
    places = {number: each.place for number, each in enumerate(named) if each is not None}
    placed = located.session(points[told])
    goal = np.array([places[number] for number in told], float) + nose_tip(face)
    cost = ((placed[:, None] - goal[None]) ** 2).sum(axis=2)
    _, chosen = linear_sum_assignment(cost)
    pairs = []
    for row, column in enumerate(chosen.tolist()):
        if row < column and chosen[column] == row:
            gain = cost[row, row] + cost[column, column] - cost[row, column] - cost[column, row]
            if gain > options.exchanged:
                pairs.append((told[row], told[column]))
    return tuple(pairs)


# Where each marker sits.


def place_markers(
    labels: Sequence[str],
    named: Sequence[Named | None],
    placed: Floats,
    face: Surface,
    options: BindOptions,
) -> tuple[Marker, ...]:
    """Return a marker for every label that is seen, on the skin, on a bone, or to be ignored."""
    seen = np.flatnonzero(np.isfinite(placed[:, 0]))
    triangles, shares, _ = barycentric(placed[seen], face)
    heights, corners = _heights(placed[seen], face), face.faces[triangles]
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
                Marker(labels[number], vertices, weights, float(heights[row]), sigma_mm=options.sigma)
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
