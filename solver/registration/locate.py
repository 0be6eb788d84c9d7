"""The face in a raw scan of any pose and unit: whether there is one, where, and in what unit.

One search serves the check of a scan and its registration, so that they give one verdict. The nose
tip is put on many places of the scan with many turns about the surface normal; each of these poses
is improved by a few steps of trimmed closest points (Besl & McKay 1992; Chetverikov et al. 2005).
The best ones slide into place by distances to planes (Chen & Medioni 1992), now with the scale, and
are judged by how much of a face they find there and how well it fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from solver.anatomy.template import Template
from solver.anatomy.warp import spread
from solver.errors import Finding, InputError, Severity
from solver.meshio.raw import RawScan
from solver.registration.scan_surface import Samples, sample
from solver.registration.units import (
    UNITS,
    candidate_scales,
    check_frame,
    choose_unit,
    given_axis,
    is_slip,
    nearest_axis,
)
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats, Ints, Surface

Axes = tuple[Floats | None, Floats | None]


@dataclass(frozen=True)
class SearchOptions:
    """The search for a face's pose; lengths in mm."""

    cell: float = 4.0  # spacing of the scan's points
    tip_spacing: float = 11.0  # of places for the nose tip
    tip_radius: float = 22.0  # of the neighbourhood from which a tip stands out
    tip_area: float = 50.0  # a cell of so many places for the tip ...
    tips_an_area: int = 3  # ... keeps these, so that spikes and clothes leave room for the nose
    first_tips: int = 160  # places that are tried first, one an area before all others
    most_tips: int = 800
    rolls: int = 14  # turns about the normal
    # points of the face, steps, and how many poses go on to the next stage
    stages: tuple[tuple[int, int, int], ...] = ((30, 2, 400), (70, 5, 48), (250, 10, 5))
    sizes: tuple[float, float] = (0.8, 1.25)  # of the scan's face by the template's
    sliding: int = 400  # points of the face that slide at first ...
    finer: int = 2  # ... and poses that go on with all points
    kept: float = 0.75  # share of the face's points that must fit; the others may lie in holes
    cut: float = 12.0  # what is farther counts as this far
    least_cosine: float = 0.4  # of normals; what faces elsewhere counts as farther by ``cut``
    axis_cosine: float = 0.5  # of a start's up and forward with the given ones


@dataclass(frozen=True)
class JudgeOptions:
    """Sliding into place, and what counts as a face; lengths in mm.

    Faces of other persons, with any expression, cost up to 2.7; the back of a head 3.4, skulls and
    lumpy balls 4.0 and more.
    """

    close: float = 8.0  # a point with the scan within this, facing the same way, is covered
    facing: float = 0.5  # cosine of the same way
    uncovered: float = 10.0  # distance that a point counts that is not covered
    soft: float = 0.5  # distances beyond it count linearly
    steps: int = 40  # of sliding at most ...
    still: float = 0.02  # ... and until the face moves by less
    sizes: tuple[float, float] = (0.72, 1.38)  # of a person's face by the template's
    growth: tuple[float, float] = (0.9, 1.1)  # in one step
    least_points: int = 80  # to slide on
    good_cost: float = 2.0  # with less no other start need be tried; smooth shoulders cost 2.3
    face_share: float = 0.72  # a face covers at least this ...
    face_cost: float = 3.3  # ... and costs at most this


SEARCH, JUDGE = SearchOptions(), JudgeOptions()
BRIEFLY = JudgeOptions(steps=15)  # for a choice among poses
# For a choice among sizes where no unit fits.
QUICK = SearchOptions(
    cell=5.0, first_tips=60, rolls=12, stages=((30, 2, 150), (70, 5, 24), (250, 10, 3)), finer=1
)
SCAN_SAMPLES, FACE_SAMPLES = 60_000, 1200  # points that stand for a scan and for a face
EXTENTS = (1e-9, 1e9)  # least and greatest extent of a scan in its own unit, whatever that is


@dataclass(frozen=True)
class FacePoints:
    """A face to look for: ``points`` (n, 3) in mm, unit ``normals`` (n, 3), its nose ``tip`` (3,).

    ``forward`` (3,) is the mean direction of the surface about the tip.
    """

    points: Floats
    normals: Floats
    tip: Floats
    forward: Floats

    def take(self, count: int) -> FacePoints:
        """Return about ``count`` points far from each other."""
        chosen = spread(self.points, count)
        return FacePoints(self.points[chosen], self.normals[chosen], self.tip, self.forward)


def face_points(face: Surface, options: SearchOptions = SEARCH) -> FacePoints:
    """Return points spread over ``face``, whose foremost point is taken for the nose tip."""
    samples = sample(face.vertices, face.faces, None, FACE_SAMPLES)
    used = face.vertices[np.unique(face.faces)]
    tip = used[np.argmax(used[:, 2])]
    near = np.linalg.norm(samples.points - tip, axis=1) < options.tip_radius
    return FacePoints(samples.points, samples.normals, tip, _direction(samples.normals[near]))


def face_surface(template: Template) -> Surface:
    """Return the part of the template's skin that is fitted and nothing else, in its numbers."""
    skin = template.skin
    is_face = np.zeros(len(skin.vertices), bool)
    is_face[template.face_vertices] = True
    return Surface(skin.vertices, skin.faces[is_face[skin.faces].all(axis=1)])


def scan_samples(scan: RawScan, count: int = SCAN_SAMPLES) -> Samples:
    """Return points spread over the scan, in its own frame; what is not a number is left out."""
    finite = np.asarray(np.isfinite(scan.vertices).all(axis=1))
    vertices = np.where(finite[:, None], scan.vertices, 0.0)
    if len(scan.faces):
        return sample(vertices, scan.faces[finite[scan.faces].all(axis=1)], None, count)
    normals = None if scan.normals is None else np.nan_to_num(scan.normals[finite])
    return sample(vertices[finite], scan.faces, normals, count)


@dataclass(frozen=True)
class FacePose:
    """A ``motion`` of the scan onto the template's face, judged.

    ``coverage`` is the share of the face's points that have the scan close, facing the same way;
    ``residual_mm`` is the mean distance of the scan from the face's planes there, and ``cost`` the
    mean distance in mm where what is not covered counts as far.
    """

    motion: Similarity
    residual_mm: float
    coverage: float
    cost: float

    def is_good(self, options: JudgeOptions = JUDGE) -> bool:
        """Return whether the pose is so good that no other start need be tried."""
        return self.cost < options.good_cost

    def is_face(self, options: JudgeOptions = JUDGE) -> bool:
        """Return whether what the pose found is a whole face."""
        return self.coverage > options.face_share and self.cost < options.face_cost


@dataclass(frozen=True)
class Location:
    """The face in a scan: its pose, the unit of the file, and its place in mm.

    ``motion`` takes the scan in mm, without scale, to the template's face: its centre, in the
    subject's axes. ``unit`` is None if the scan's size fits no unit by name, ``size_known`` false
    if it does not even fit a decimal slip of one: the size is then the template's. ``size`` is the
    face's by the template's; ``up`` and ``forward`` are the axes of the file that come nearest to
    the subject's.
    """

    pose: FacePose
    is_face: bool
    unit: str | None
    mm_per_unit: float
    size_known: bool
    motion: Similarity
    size: float
    up: str
    forward: str

    def apply(self, points: Floats) -> Floats:
        """Return points (n, 3) of the file in mm in the subject's frame."""
        return self.motion(self.mm_per_unit * points)


def locate_face(
    scan: RawScan,
    samples: Samples,
    face: FacePoints,
    frame: Mapping[str, Any],
    marks: tuple[Floats, Floats] | None = None,
) -> Location:
    """Find the best place of the face in a scan, however bad, and with it unit and axes.

    Parameters
    ----------
    scan
        Mended, in its own unit and axes.
    samples
        Of it (:func:`scan_samples`).
    face
        The template's.
    frame
        The options ``unit``, ``up`` and ``forward``, as :data:`~solver.registration.units.FRAME`.
    marks
        Landmarks: points (k, 3) of the scan and of the template. They replace the search, and who
        sets them has seen a face.

    Raises
    ------
    InputError
        ``options.unit``, ``options.axes``; ``scan.unit_unknown`` for a scan without extent.
    """
    check_frame(frame)
    extent = _extent(samples)
    if not EXTENTS[0] < extent < EXTENTS[1]:
        message = f"No unit makes what is in {scan.file} as large as a face."
        raise InputError("scan.unit_unknown", message, file=scan.file)
    unit, samples = str(frame["unit"]), orient_outward(samples)
    if marks is None:
        upright = (given_axis(frame, "up"), given_axis(frame, "forward"))
        pose = _search(face, samples, unit, scan.mm_per_unit, upright)
        return _location(pose, pose.is_face(), face, unit, scan.mm_per_unit)
    start = fit_similarity(*marks)
    pose = slide_into_place(face, samples, KDTree(samples.points), start, start.scale)
    return _location(pose, True, face, unit, scan.mm_per_unit)


def likely_scales(scan: RawScan, samples: Samples, frame: Mapping[str, Any]) -> list[float]:
    """Return the mm per unit that come first for a scan."""
    rounds = candidate_scales(_extent(samples), str(frame["unit"]), scan.mm_per_unit)
    return rounds[0] if rounds else [1.0]


def location_findings(scan: RawScan, location: Location, frame: Mapping[str, Any]) -> list[Finding]:
    """Return whether there is no face, or one of a size that speaks against the unit.

    The unit is the one that was given, declared or assumed. With an ``error`` among them nothing
    right would come of the scan.
    """
    if not location.is_face:
        pose = location.pose
        message = (
            f"{scan.file} shows no face: the best fit covers {pose.coverage:.0%} of a face and is "
            f"{pose.residual_mm:.1f} mm off."
        )
        return [Finding("scan.not_a_face", "error", message)]
    given = str(frame["unit"])
    expected = UNITS.get(given, scan.mm_per_unit or 1.0)
    found = location.mm_per_unit
    figures = {"expected": expected, "found": found, "unit": location.unit}
    if found == expected:
        return []
    ratio = expected / found
    size = f"{ratio:.3g} times too large" if ratio > 1 else f"{1 / ratio:.3g} times too small"
    if location.unit is None and not is_slip(found / expected):
        no_unit = f"No unit makes the face in {scan.file} as large as a face"
        if given != "auto":
            no_unit = f"Read as given, the face in {scan.file} would be {size}, in no unit right"
        message = f"{no_unit}; it gets the template's size."
        return [Finding("scan.unit_unknown", "warning", message, context=figures)]
    severity: Severity = "error" if given != "auto" else "warning"
    declared = "as the format says" if scan.mm_per_unit else "in mm"
    source = "as given" if given != "auto" else declared
    as_what = f"in {location.unit}" if location.unit else f"at {found:g} mm a unit"
    message = f"Read {source}, the face would be {size}; it fits {as_what}."
    return [Finding("scan.scale", severity, message, context=figures)]


def _extent(samples: Samples) -> float:
    low, high = np.quantile(samples.points, [0.005, 0.995], axis=0)
    return float((high - low).max())


def _search(
    face: FacePoints, samples: Samples, unit: str, declared: float | None, upright: Axes
) -> FacePose:
    """Return the best pose, however bad: in known units first, in odd ones if none fits."""
    known, *others = candidate_scales(_extent(samples), unit, declared) or [[1.0]]
    best = find_pose(face, samples, known, upright)
    for scales in others:
        if not best.is_face() or choose_unit(best.motion.scale, unit, declared)[1] is None:
            found = find_pose(face, samples, scales, upright, QUICK)
            if found.cost < best.cost:
                best, known = found, [found.motion.scale]
    if best.is_good():
        return best
    more = [find_pose(face, samples, known, upright, first=False)]
    if known[0] == best.motion.scale:
        more.append(find_pose(face, samples, known, upright))
    return min(best, *more, key=lambda pose: pose.cost)


def _location(
    pose: FacePose, is_face: bool, face: FacePoints, unit: str, declared: float | None
) -> Location:
    motion = pose.motion
    factor, name = choose_unit(motion.scale, unit, declared)
    centre = face.points.mean(axis=0)
    there = factor * motion.inverse()(centre[None])[0]
    return Location(
        pose=pose,
        is_face=is_face,
        unit=name,
        mm_per_unit=factor,
        size_known=factor != motion.scale,
        motion=Similarity(1.0, motion.rotation, centre - motion.rotation @ there),
        size=factor / motion.scale,
        up=nearest_axis(motion.rotation[1]),
        forward=nearest_axis(motion.rotation[2]),
    )


def find_pose(
    face: FacePoints,
    samples: Samples,
    scales: list[float],
    upright: Axes = (None, None),
    search: SearchOptions = SEARCH,
    *,
    first: bool = True,
) -> FacePose:
    """Return the best pose of a face at one of the ``scales`` (mm per unit), however bad.

    Scales after a good pose are not tried. ``samples`` face outwards; ``upright`` are the scan's
    directions (3,) of up and forward, where they are known. The nose tip is put on the ``first``
    places, which stand out most of what is around them, or on the others.
    """
    tree, few = KDTree(samples.points), face.take(search.sliding)
    batch = slice(search.first_tips) if first else slice(search.first_tips, search.most_tips)
    best = FacePose(Similarity(scales[0], np.eye(3), np.zeros(3)), np.inf, 0.0, np.inf)
    for scale in scales:
        cloud = _Cloud.thin(scale * samples.points, samples.normals, search.cell)
        poses = _starts(face, cloud, batch, upright, search)
        if not len(poses.sizes):
            continue
        found = []
        for start in _improve(poses, face, cloud, search):
            motion = Similarity(start.scale * scale, start.rotation, start.shift)
            found.append(slide_into_place(few, samples, tree, motion, scale, BRIEFLY))
        found.sort(key=lambda pose: pose.cost)
        for pose in found[: search.finer]:
            slid = slide_into_place(face, samples, tree, pose.motion, scale)
            best = min(best, slid, key=lambda pose: pose.cost)
        if best.is_good():
            break
    return best


# The search: many rigid poses of the face on the scan at once.


@dataclass(frozen=True)
class _Cloud:
    """A scan's evenly spaced ``points`` (n, 3) in mm, unit ``normals`` (n, 3) and ``tree``."""

    points: Floats
    normals: Floats
    tree: KDTree

    @classmethod
    def thin(cls, points: Floats, normals: Floats, cell: float) -> _Cloud:
        """Return the means of points and normals in every cell of a grid."""
        _, number = _cells(points, cell)
        count = np.bincount(number)[:, None]

        def mean(values: Floats) -> Floats:
            sums = [np.bincount(number, values[:, axis]) for axis in range(3)]
            return np.asarray(np.stack(sums, axis=1) / count)

        direction = mean(normals)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-12
        places = mean(points)
        return cls(places, direction, KDTree(places))


@dataclass(frozen=True)
class _Poses:
    """Motions of the face onto the scan: ``sizes`` (p,), ``turns`` (p, 3, 3), ``shifts`` (p, 3)."""

    sizes: Floats
    turns: Floats
    shifts: Floats

    def take(self, chosen: Ints) -> _Poses:
        return _Poses(self.sizes[chosen], self.turns[chosen], self.shifts[chosen])

    def place(self, points: Floats) -> Floats:
        """Return the images (p, n, 3) of ``points`` (n, 3)."""
        turned = np.einsum("pij,nj->pni", self.turns, points)
        return np.asarray(self.sizes[:, None, None] * turned + self.shifts[:, None, :])

    def motions(self) -> list[Similarity]:
        """Return the motions of the scan onto the face, one a pose."""
        triples = zip(self.sizes, self.turns, self.shifts, strict=True)
        return [Similarity(float(size), *motion).inverse() for size, *motion in triples]


def _cells(points: Floats, size: float) -> tuple[Ints, Ints]:
    """Return the first point of every cell of a grid, and the cell of every point."""
    keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, number.reshape(-1)


def _direction(normals: Floats) -> Floats:
    mean = normals.mean(axis=0)
    return np.asarray(mean / (np.linalg.norm(mean) + 1e-12))


def orient_outward(samples: Samples) -> Samples:
    """Return the samples with normals that point outwards, whatever the scan's winding is."""
    points, normals = samples.points, samples.normals.copy()
    away = points - np.median(points, axis=0)
    height = np.einsum("nd,nd->n", normals, away)
    if samples.oriented:
        return samples if height.sum() >= 0 else Samples(points, -normals, True)
    normals *= np.sign(height + 1e-12)[:, None]
    near = KDTree(points).query(points, 12)[1]
    for _ in range(8):
        mean = normals[near].mean(axis=1)
        normals *= np.sign(np.einsum("nd,nd->n", normals, mean) + 1e-12)[:, None]
    return Samples(points, normals, False)


def _starts(
    face: FacePoints, cloud: _Cloud, batch: slice, upright: Axes, options: SearchOptions
) -> _Poses:
    """Put the nose tip on a ``batch`` of places that stand out, with all turns about the normal."""
    first, _ = _cells(cloud.points, options.tip_spacing)
    places = cloud.points[first]
    near = cloud.tree.query_ball_point(places, options.tip_radius)
    height, forward = np.empty(len(first)), np.empty((len(first), 3))
    for number, members in enumerate(near):
        forward[number] = _direction(cloud.normals[members])
        height[number] = (places[number] - cloud.points[members].mean(axis=0)) @ forward[number]
    _, area = _cells(places, options.tip_area)
    order = np.lexsort((-height, area))
    rank = np.arange(len(order)) - np.searchsorted(area[order], area[order])
    highest = order[rank < options.tips_an_area]
    chosen = highest[np.lexsort((-height[highest], rank[rank < options.tips_an_area]))]
    chosen = chosen[batch]
    tips, forward = places[chosen], forward[chosen]
    side = np.cross(np.eye(3)[np.argmin(np.abs(forward), axis=1)], forward)
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-12
    up = np.cross(forward, side)
    level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [face.forward])[0].as_matrix()
    turns = []
    for angle in np.linspace(0, 2 * np.pi, options.rolls, endpoint=False):
        x = np.cos(angle) * side + np.sin(angle) * up
        turns.append(np.stack([x, np.cross(forward, x), forward], axis=2) @ level)
    turn = np.concatenate(turns)
    poses = _Poses(np.ones(len(turn)), turn, np.tile(tips, (options.rolls, 1)) - turn @ face.tip)
    return _keep_upright(poses, upright, options)


def _keep_upright(poses: _Poses, upright: Axes, options: SearchOptions) -> _Poses:
    """Return the poses whose up (y) and forward (z) are about the given ones; all if none is."""
    kept = np.ones(len(poses.turns), dtype=bool)
    for axis, given in zip((1, 2), upright, strict=True):
        if given is not None:
            kept &= poses.turns[:, :, axis] @ given > options.axis_cosine
    return poses.take(np.flatnonzero(kept)) if kept.any() else poses


def _improve(
    poses: _Poses, face: FacePoints, cloud: _Cloud, options: SearchOptions
) -> list[Similarity]:
    """Return the motions of the scan onto the face of the best poses after all stages."""
    for number, (points, steps, survivors) in enumerate(options.stages):
        few = face.take(points)
        for _ in range(steps):
            poses = _step(poses, few, cloud, options, sizes=number > 0)
        distance = _match(poses, few, cloud, options)[1]
        scores = np.minimum(distance / poses.sizes[:, None], options.cut).mean(axis=1)
        poses = poses.take(np.argsort(scores, kind="stable")[:survivors])
    return poses.motions()


def _match(
    poses: _Poses, face: FacePoints, cloud: _Cloud, options: SearchOptions
) -> tuple[Floats, Floats, Ints]:
    """Return the placed points (p, n, 3), their distances and the closest numbers (p, n).

    A point whose closest one faces elsewhere counts as far away.
    """
    placed = poses.place(face.points)
    distance, near = cloud.tree.query(placed.reshape(-1, 3))
    distance, near = distance.reshape(placed.shape[:2]), near.reshape(placed.shape[:2])
    normals = np.einsum("pij,nj->pni", poses.turns, face.normals)
    agree = np.einsum("pni,pni->pn", normals, cloud.normals[near]) > options.least_cosine
    return placed, np.where(agree, distance, distance + options.cut), near


def _step(
    poses: _Poses, face: FacePoints, cloud: _Cloud, options: SearchOptions, *, sizes: bool
) -> _Poses:
    """Move every pose by the best motion of its closer points onto their closest ones.

    With ``sizes`` the face grows or shrinks too, by the ratio of the spreads (Horn 1987).
    """
    placed, distance, near = _match(poses, face, cloud, options)
    limit = np.quantile(distance, options.kept, axis=1, keepdims=True)
    weights = (distance <= limit).astype(float)
    weights /= weights.sum(axis=1, keepdims=True)
    targets = cloud.points[near]
    centre = np.einsum("pn,pni->pi", weights, placed)
    goal = np.einsum("pn,pni->pi", weights, targets)
    placed, targets = placed - centre[:, None], targets - goal[:, None]
    u, _, vt = np.linalg.svd(np.einsum("pn,pni,pnj->pij", weights, targets, placed))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turn = u @ vt
    size = poses.sizes
    if sizes:
        ours, theirs = (np.einsum("pn,pni,pni->p", weights, x, x) for x in (placed, targets))
        size = np.clip(size * np.sqrt(theirs / (ours + 1e-12)), *options.sizes)
    growth = size / poses.sizes
    shift = growth[:, None] * np.einsum("pij,pj->pi", turn, poses.shifts - centre) + goal
    return _Poses(size, turn @ poses.turns, shift)


# Sliding into place, and the verdict.


def slide_into_place(
    face: FacePoints,
    scan: Samples,
    tree: KDTree,
    start: Similarity,
    size: float,
    options: JudgeOptions = JUDGE,
    kept: float = SEARCH.kept,
) -> FacePose:
    """Return the better of ``start`` and the pose after linearised steps with the scale.

    The scale stays within the sizes of faces about ``size`` (mm per unit); ``tree`` is the scan's.
    """
    motion = start
    for _ in range(options.steps):
        gap, near = tree.query(motion.inverse()(face.points))
        matched = motion(scan.points[near])
        facing = np.abs((motion.turn(scan.normals[near]) * face.normals).sum(axis=1))
        used = (gap <= np.quantile(gap, kept)) & (facing > options.facing)
        if used.sum() < options.least_points:
            break
        p, n = matched[used], face.normals[used]
        centre = p.mean(axis=0)
        error = ((face.points[used] - p) * n).sum(axis=1)
        p = p - centre
        rows = np.column_stack([np.cross(p, n), n, (p * n).sum(axis=1)])
        weight = 1 / np.maximum(np.abs(error), options.soft)
        normal = rows.T @ (weight[:, None] * rows)
        normal += np.diag([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1.0])
        step = np.linalg.solve(normal, rows.T @ (weight * error))
        low, high = (size * limit / motion.scale for limit in options.sizes)
        least, most = options.growth
        growth = float(np.clip(1 + step[6], max(low, least), min(high, most)))
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        about = Similarity(growth, turn, centre + step[3:6] - growth * turn @ centre)
        motion = motion.then(about)
        if np.linalg.norm(about(face.points) - face.points, axis=1).max() < options.still:
            break
    poses = (judge_pose(face, scan, tree, each, options) for each in (start, motion))
    return min(poses, key=lambda pose: pose.cost)


def judge_pose(
    face: FacePoints, scan: Samples, tree: KDTree, motion: Similarity, options: JudgeOptions = JUDGE
) -> FacePose:
    """Return ``motion`` with how much of the face it finds in the scan, and how well that fits."""
    gap, near = tree.query(motion.inverse()(face.points))
    facing = (motion.turn(scan.normals[near]) * face.normals).sum(axis=1)
    if not scan.oriented:
        facing = np.abs(facing)
    close = gap * motion.scale < options.close
    covered = max(close & (facing > options.facing), close & (facing < -options.facing), key=np.sum)
    if not covered.any():
        return FacePose(motion, options.uncovered, 0.0, options.uncovered)
    off_plane = np.abs(((motion(scan.points[near]) - face.points) * face.normals).sum(axis=1))
    residual, share = float(off_plane[covered].mean()), float(covered.mean())
    cost = share * residual + (1 - share) * options.uncovered
    return FacePose(motion, residual, share, cost)
