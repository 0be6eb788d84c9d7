"""The pose of a face in a cloud of points: a search that needs no start.

The nose tip is put on many places of the scan with many turns about the surface normal; each of
these poses is improved by a few steps of trimmed closest points (Besl & McKay 1992; Chetverikov et
al. 2005). The best ones slide into place by distances to planes (Chen & Medioni 1992), now with the
scale, and are judged by how much of a face they find there and how well it fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from solver.anatomy.warp import spread
from solver.registration.scan_surface import Samples, cells, mean_by_cell, sample
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface, unit_rows

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
    stages: tuple[tuple[int, int, int], ...] = ((30, 2, 400), (70, 5, 48), (250, 10, 16))
    apart: float = 20.0  # of the last ones, else all may lie on one smooth shoulder
    sizes: tuple[float, float] = (0.8, 1.25)  # of the scan's face by the template's
    sliding: int = 400  # points of the face that slide at first ...
    finer: int = 2  # ... and poses that go on with all points
    kept: float = 0.75  # share of the face's points that must fit; the others may lie in holes
    cut: float = 12.0  # what is farther counts as this far
    least_cosine: float = 0.4  # of normals; what faces elsewhere counts as farther by ``cut``
    axis_cosine: float = 0.5  # of a start's up and forward with the given ones


@dataclass(frozen=True)
class RefinementOptions:
    """Sliding into place, and what counts as a face; lengths in mm.

    Faces of other persons, with any expression, cost up to 2.7; the back of a head 3.4, skulls and
    lumpy balls 4.0 and more.
    """

    kept: float = 0.75  # share of the face's points that slide; the others may lie in holes
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


SEARCH = SearchOptions()
REFINEMENT = RefinementOptions()
BRIEF_REFINEMENT = RefinementOptions(steps=15)  # for a choice among poses
# For a choice among sizes where no unit fits.
QUICK_SEARCH = SearchOptions(
    cell=5.0, first_tips=60, rolls=12, stages=((30, 2, 150), (70, 5, 24), (250, 10, 8)), finer=1
)
FACE_SAMPLES = 1200  # points that stand for a face


@dataclass(frozen=True)
class FacePoints:
    """A face to look for."""

    points: Floats  # (n, 3) in mm
    normals: Floats  # (n, 3), of length 1
    tip: Floats  # (3,) of the nose
    forward: Floats  # (3,) mean direction of the surface about the tip

    def take(self, count: int) -> FacePoints:
        """Return about ``count`` points far from each other."""
        chosen = spread(self.points, count)
        return FacePoints(self.points[chosen], self.normals[chosen], self.tip, self.forward)


def nose_tip(face: Surface) -> Floats:
    """Return the foremost point (3,) of a face, which is taken for the tip of its nose."""
    used = face.vertices[np.unique(face.faces)]
    return np.asarray(used[np.argmax(used[:, 2])])


def face_points(face: Surface, options: SearchOptions = SEARCH) -> FacePoints:
    """Return points spread over ``face``."""
    samples = sample(face.vertices, face.faces, None, FACE_SAMPLES)
    tip = nose_tip(face)
    near = np.linalg.norm(samples.points - tip, axis=1) < options.tip_radius
    forward = unit_rows(samples.normals[near].mean(axis=0))
    return FacePoints(samples.points, samples.normals, tip, forward)


@dataclass(frozen=True)
class FacePose:
    """A motion of the scan onto the template's face, judged."""

    motion: Similarity
    residual_mm: float  # mean distance of the scan from the face's planes where it is covered
    coverage: float  # share of the face's points with the scan close, facing the same way
    cost: float  # mean distance in mm where what is not covered counts as far
    is_good: bool = False  # so good that no other start need be tried
    is_face: bool = False  # whether what is found is a whole face


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
    few = face.take(search.sliding)
    batch = slice(search.first_tips) if first else slice(search.first_tips, search.most_tips)
    best = FacePose(Similarity(scales[0], np.eye(3), np.zeros(3)), np.inf, 0.0, np.inf)
    for scale in scales:
        points = scale * samples.points
        _, number = cells(points, search.cell)
        places = mean_by_cell(points, number)
        normals = unit_rows(mean_by_cell(samples.normals, number))
        cloud = Samples(places, normals, samples.oriented)
        poses = _starts(face, cloud, batch, upright, search)
        if not len(poses.sizes):
            continue
        found: list[FacePose] = []
        for start in _improve(poses, face, cloud, search):
            motion = Similarity(start.scale * scale, start.rotation, start.shift)
            found.append(refine_pose(few, samples, motion, scale, BRIEF_REFINEMENT))
            if found[-1].is_good:
                break
        found.sort(key=lambda pose: pose.cost)
        for pose in found[: search.finer]:
            slid = refine_pose(face, samples, pose.motion, scale)
            best = min(best, slid, key=lambda pose: pose.cost)
        if best.is_good:
            break
    return best


# The search: many rigid poses of the face on the scan at once.


@dataclass(frozen=True)
class _Poses:
    """Motions of the face onto the scan: ``sizes`` (p,), ``turns`` (p, 3, 3), ``shifts`` (p, 3)."""

    sizes: Floats
    turns: Floats
    shifts: Floats

    def place(self, points: Floats) -> Floats:
        """Return where ``points`` (n, 3) of the face are, (p, n, 3)."""
        turned = np.einsum("pij,nj->pni", self.turns, points)
        return np.asarray(self.sizes[:, None, None] * turned + self.shifts[:, None, :])

    def take(self, chosen: Ints) -> _Poses:
        return _Poses(self.sizes[chosen], self.turns[chosen], self.shifts[chosen])


def _starts(
    face: FacePoints, cloud: Samples, batch: slice, upright: Axes, options: SearchOptions
) -> _Poses:
    """Put the nose tip on a ``batch`` of places that stand out, with all turns about the normal."""
    first, _ = cells(cloud.points, options.tip_spacing)
    places = cloud.points[first]
    near = cloud.tree.query_ball_point(places, options.tip_radius)
    members = np.concatenate(near).astype(np.int64)
    number = np.repeat(np.arange(len(first)), [len(each) for each in near])
    forward = unit_rows(mean_by_cell(cloud.normals[members], number))
    height = ((places - mean_by_cell(cloud.points[members], number)) * forward).sum(axis=1)
    _, area = cells(places, options.tip_area)
    order = np.lexsort((-height, area))
    rank = np.arange(len(order)) - np.searchsorted(area[order], area[order])
    highest = order[rank < options.tips_an_area]
    rank = rank[rank < options.tips_an_area]
    chosen = highest[np.lexsort((-height[highest], rank))][batch]
    tips = places[chosen]
    forward = forward[chosen]
    side = unit_rows(np.cross(np.eye(3)[np.argmin(np.abs(forward), axis=1)], forward))
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
    poses: _Poses, face: FacePoints, cloud: Samples, options: SearchOptions
) -> list[Similarity]:
    """Return the motions of the scan onto the face of the best poses after all stages."""
    for number, (points, steps, survivors) in enumerate(options.stages):
        few = face.take(points)
        for _ in range(steps):
            poses = _step(poses, few, cloud, options, sizes=number > 0)
        distance = _match(poses, few, cloud, options)[1]
        scores = np.minimum(distance / poses.sizes[:, None], options.cut).mean(axis=1)
        order = np.argsort(scores, kind="stable")
        poses = poses.take(order[:survivors] if number + 1 < len(options.stages) else order)
    poses = _keep_apart(poses, face.points, options)
    triples = zip(poses.sizes, poses.turns, poses.shifts, strict=True)
    return [Similarity(float(size), *motion).inverse() for size, *motion in triples]


def _keep_apart(poses: _Poses, points: Floats, options: SearchOptions) -> _Poses:
    """Return the first poses that put the face somewhere else than those before them."""
    corners = points[[*points.argmin(axis=0), *points.argmax(axis=0)]]
    placed = poses.place(corners)
    kept: list[int] = []
    for number, here in enumerate(placed):
        off = np.linalg.norm(placed[kept] - here, axis=2).mean(axis=1)
        if len(kept) < options.stages[-1][2] and (off > options.apart).all():
            kept.append(number)
    return poses.take(np.array(kept))


def _match(
    poses: _Poses, face: FacePoints, cloud: Samples, options: SearchOptions
) -> tuple[Floats, Floats, Ints]:
    """Return the placed points (p, n, 3), their distances and the closest numbers (p, n).

    A point whose closest one faces elsewhere counts as far away.
    """
    placed = poses.place(face.points)
    normals = np.einsum("pij,nj->pni", poses.turns, face.normals)
    distance, near = cloud.tree.query(placed.reshape(-1, 3))
    distance = distance.reshape(placed.shape[:2])
    near = near.reshape(placed.shape[:2])
    agree = np.einsum("pni,pni->pn", normals, cloud.normals[near]) > options.least_cosine
    return placed, np.where(agree, distance, distance + options.cut), near


def _step(
    poses: _Poses, face: FacePoints, cloud: Samples, options: SearchOptions, *, sizes: bool
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
    placed = placed - centre[:, None]
    targets = targets - goal[:, None]
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


def refine_pose(
    face: FacePoints,
    scan: Samples,
    start: Similarity,
    size: float,
    options: RefinementOptions = REFINEMENT,
) -> FacePose:
    """Return the better of ``start`` and the pose after linearised steps with the scale.

    The scale stays within the sizes of faces about ``size`` (mm per unit).
    """
    motion = start
    for _ in range(options.steps):
        gap, near = scan.tree.query(motion.inverse()(face.points))
        matched = motion(scan.points[near])
        facing = np.abs((motion.turn(scan.normals[near]) * face.normals).sum(axis=1))
        used = (gap <= np.quantile(gap, options.kept)) & (facing > options.facing)
        if used.sum() < options.least_points:
            break
        p = matched[used]
        n = face.normals[used]
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
    poses = (judge_pose(face, scan, each, options) for each in (start, motion))
    return min(poses, key=lambda pose: pose.cost)


def judge_pose(
    face: FacePoints, scan: Samples, motion: Similarity, options: RefinementOptions = REFINEMENT
) -> FacePose:
    """Return ``motion`` with how much of the face it finds in the scan, and how well that fits."""
    gap, near = scan.tree.query(motion.inverse()(face.points))
    facing = (motion.turn(scan.normals[near]) * face.normals).sum(axis=1)
    if not scan.oriented:
        facing = np.abs(facing)
    close = gap * motion.scale < options.close
    covered = max(close & (facing > options.facing), close & (facing < -options.facing), key=np.sum)
    if not covered.any():
        return FacePose(motion, options.uncovered, 0.0, options.uncovered)
    off_plane = np.abs(((motion(scan.points[near]) - face.points) * face.normals).sum(axis=1))
    residual = float(off_plane[covered].mean())
    share = float(covered.mean())
    cost = share * residual + (1 - share) * options.uncovered
    return FacePose(
        motion,
        residual,
        share,
        cost,
        is_good=cost < options.good_cost,
        is_face=share > options.face_share and cost < options.face_cost,
    )
