"""Where the face is in a scan of any pose: a search over the whole surface, without landmarks.

The nose tip is put on many places of the scan with many turns about the surface normal; each of
these poses is improved by a few steps of trimmed closest points (Besl & McKay 1992; Chetverikov et
al. 2005), and the best of them by more steps with more points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree, cKDTree
from scipy.spatial.transform import Rotation

from solver.anatomy.template import Template
from solver.anatomy.warp import similarity, spread
from solver.errors import InputError
from solver.meshio.raw import RawScan
from solver.registration.mend import (
    Samples,
    sample,
)
from solver.registration.scan_surface import ScanSurface
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface

THIN_MM = 4.0
"""Spacing of the scan's points in the search."""
TIP_SPACING_MM = 11.0
TIP_RADIUS_MM = 22.0
TIP_AREA_MM = 50.0
TIPS_AN_AREA = 3
MOST_TIPS = 800
ROLLS = 14
STAGES = ((30, 2, 1200), (70, 5, 96), (250, 12, 10), (900, 15, 1))
"""Points of the face, steps, and how many poses go on to the next stage."""
KEPT = 0.75
"""Share of the face's points that must fit; the others may lie in holes."""
CUT_MM = 12.0
MIN_COSINE = 0.4
SIMILAR_COSINE = 0.5


@dataclass(frozen=True)
class FacePatch:
    """The template's outer face: ``points`` and unit ``normals`` (n, 3), and its nose ``tip``."""

    points: Floats
    normals: Floats
    tip: Floats

    def thinned(self, count: int) -> FacePatch:
        """Return about ``count`` points far from each other."""
        chosen = spread(self.points, count)
        return FacePatch(self.points[chosen], self.normals[chosen], self.tip)


@dataclass(frozen=True)
class Poses:
    """Motions of the face onto the scan: ``turns`` (p, 3, 3), ``shifts`` (p, 3)."""

    turns: Floats
    shifts: Floats

    def take(self, chosen: Ints) -> Poses:
        """Return some of the poses."""
        return Poses(self.turns[chosen], self.shifts[chosen])


def find_face(
    patch: FacePatch, scan: ScanSurface, upright: tuple[Floats | None, Floats | None]
) -> tuple[Similarity, float]:
    """Return the motion of a scan in mm into the face's frame, and how badly the face fits (mm).

    Parameters
    ----------
    patch
        The template's face.
    scan
        In mm, in any pose.
    upright
        The scan's directions (3,) of up and forward, where they are known.
    """
    cloud, directions = _thin(scan.vertices, scan.normals)
    tree = cKDTree(cloud)
    poses = _allowed(_starts(patch, cloud, directions, tree), upright)
    for points, steps, survivors in STAGES:
        sample = patch.thinned(points)
        for _ in range(steps):
            poses = _step(poses, sample, cloud, directions, tree)
        scores = _scores(poses, sample, directions, tree)
        best = np.argsort(scores, kind="stable")[:survivors]
        poses, scores = poses.take(best), scores[best]
    motion = Similarity(1.0, poses.turns[0], poses.shifts[0])
    return motion.inverse(), float(scores[0])


def _thin(vertices: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Return the means of points and normals in every cell of a grid."""
    _, number = _cells(vertices, THIN_MM)
    count = np.bincount(number)[:, None]

    def mean(values: Floats) -> Floats:
        sums = [np.bincount(number, values[:, axis]) for axis in range(3)]
        return np.asarray(np.stack(sums, axis=1) / count)

    direction = mean(normals)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-12
    return mean(vertices), direction


def _cells(points: Floats, size: float) -> tuple[Ints, Ints]:
    """Return the first point of every cell of a grid, and the cell of every point."""
    keys = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, number.reshape(-1)


def _starts(patch: FacePatch, cloud: Floats, directions: Floats, tree: cKDTree) -> Poses:
    """Put the nose tip on the places that stand out most, with all turns about the normal."""
    first, _ = _cells(cloud, TIP_SPACING_MM)
    near = tree.query_ball_point(cloud[first], TIP_RADIUS_MM)
    height, forward = np.empty(len(first)), np.empty((len(first), 3))
    for number, members in enumerate(near):
        mean = directions[members].mean(axis=0)
        forward[number] = mean / (np.linalg.norm(mean) + 1e-12)
        height[number] = (cloud[first[number]] - cloud[members].mean(axis=0)) @ forward[number]
    # the highest of every neighbourhood, so that spikes and clothes leave room for the nose
    _, area = _cells(cloud[first], TIP_AREA_MM)
    order = np.lexsort((-height, area))
    rank = np.arange(len(order)) - np.searchsorted(area[order], area[order])
    best = order[rank < TIPS_AN_AREA]
    chosen = best[np.argsort(-height[best], kind="stable")[:MOST_TIPS]]
    tips, forward = cloud[first[chosen]], forward[chosen]
    side = np.cross(np.eye(3)[np.argmin(np.abs(forward), axis=1)], forward)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(forward, side)
    turns = []
    for angle in np.linspace(0, 2 * np.pi, ROLLS, endpoint=False):
        x = np.cos(angle) * side + np.sin(angle) * up
        turns.append(np.stack([x, np.cross(forward, x), forward], axis=2))
    turn = np.concatenate(turns)
    return Poses(turn, np.tile(tips, (ROLLS, 1)) - turn @ patch.tip)


def _allowed(poses: Poses, upright: tuple[Floats | None, Floats | None]) -> Poses:
    """Return the poses whose up (y) and forward (z) are about the given ones; all if none is."""
    kept = np.ones(len(poses.turns), dtype=bool)
    for axis, given in zip((1, 2), upright, strict=True):
        if given is not None:
            kept &= poses.turns[:, :, axis] @ given > SIMILAR_COSINE
    return poses.take(np.flatnonzero(kept)) if kept.any() else poses


def _placed(poses: Poses, patch: FacePatch) -> Floats:
    return np.asarray(
        np.einsum("pij,nj->pni", poses.turns, patch.points) + poses.shifts[:, None, :]
    )


def _matched(
    poses: Poses, patch: FacePatch, directions: Floats, tree: cKDTree
) -> tuple[Floats, Floats, Ints]:
    """Return the placed points (p, n, 3), their distances and the closest numbers (p, n).

    A point whose closest one faces elsewhere counts as far away.
    """
    placed = _placed(poses, patch)
    distance, near = tree.query(placed.reshape(-1, 3))
    distance, near = distance.reshape(placed.shape[:2]), near.reshape(placed.shape[:2])
    normals = np.einsum("pij,nj->pni", poses.turns, patch.normals)
    agree = np.einsum("pni,pni->pn", normals, directions[near]) > MIN_COSINE
    return placed, np.where(agree, distance, distance + CUT_MM), near


def _step(
    poses: Poses, patch: FacePatch, cloud: Floats, directions: Floats, tree: cKDTree
) -> Poses:
    """Move every pose by the best motion of its closer points onto their closest ones."""
    placed, distance, near = _matched(poses, patch, directions, tree)
    limit = np.quantile(distance, KEPT, axis=1, keepdims=True)
    weights = (distance <= limit).astype(float)
    weights /= weights.sum(axis=1, keepdims=True)
    targets = cloud[near]
    centre = np.einsum("pn,pni->pi", weights, placed)
    goal = np.einsum("pn,pni->pi", weights, targets)
    covariance = np.einsum(
        "pn,pni,pnj->pij", weights, targets - goal[:, None], placed - centre[:, None]
    )
    u, _, vt = np.linalg.svd(covariance)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turn = u @ vt
    shift = goal - np.einsum("pij,pj->pi", turn, centre)
    return Poses(turn @ poses.turns, np.einsum("pij,pj->pi", turn, poses.shifts) + shift)


def _scores(poses: Poses, patch: FacePatch, directions: Floats, tree: cKDTree) -> Floats:
    _, distance, _ = _matched(poses, patch, directions, tree)
    return np.asarray(np.minimum(distance, CUT_MM).mean(axis=1))


# Where a face is in a scan, at any place, in any direction and unit.
#
# Many starts (directions x places of the nose tip) are scored on a few points, the best are refined
# by iterated closest points (Besl & McKay 1992) with a similarity (Umeyama 1991), trimmed so that
# hair, shoulders and holes do not pull (Chetverikov et al. 2005).


COARSE_POINTS, FINE_POINTS = 160, 1200
TREE_POINTS = 6000
REACH_MM = 30.0  # what is farther from the face than this is not there
CELL_MM = 22.0
CLOSE_MM = 8.0
TRIED, REFINED, FINER = 250, 36, 5
SETTLING = 12
SOFT_MM = 0.5
UNCOVERED_MM = 10.0
SIZES = (0.72, 1.38)
"""Least and greatest size of a person's face by the template's."""
GOOD_SHARE, GOOD_MM = 0.85, 2.0
FACE_SHARE, FACE_COST = 0.72, 3.6
EXTRA_DIRECTIONS = 420


@dataclass(frozen=True)
class Pose:
    """A similarity from the scan's frame to the template's: y = scale * rotation x + translation.

    ``coverage`` is the share of the face's points that have the scan within CLOSE_MM, facing the
    same way; ``residual_mm`` is the mean distance of the scan from the face's planes there.
    """

    scale: float
    rotation: Floats
    translation: Floats
    residual_mm: float
    coverage: float

    def apply(self, points: Floats) -> Floats:
        """Return points (n, 3) of the scan in the template's frame."""
        return self.scale * points @ self.rotation.T + self.translation

    @property
    def cost(self) -> float:
        """Return the mean distance in mm, where what is not covered counts as UNCOVERED_MM."""
        return self.coverage * self.residual_mm + (1 - self.coverage) * UNCOVERED_MM


class FacePoints:
    """Points of a template's face: ``points`` (n, 3), ``normals`` (n, 3) and the nose tip (3,)."""

    def __init__(self, face: Surface) -> None:
        samples = sample(face.vertices, face.faces, None, FINE_POINTS)
        self.points, self.normals = samples.points, samples.normals
        used = face.vertices[np.unique(face.faces)]
        self.nose_tip: Floats = used[np.argmax(used[:, 2])]


def axis_directions() -> Floats:
    """Return the 24 rotations (24, 3, 3) that map axes onto axes."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.array(found)


def all_directions() -> Floats:
    """Return rotations (n, 3, 3) about 25 degrees apart."""
    return np.asarray(Rotation.random(EXTRA_DIRECTIONS, rng=np.random.default_rng(5)).as_matrix())


def directions_around(rotation: Floats) -> Floats:
    """Return rotations (26, 3, 3) that lie about 35 degrees off ``rotation``, in all ways."""
    axes = np.array([axis for axis in product((-1, 0, 1), repeat=3) if any(axis)], np.float64)
    turns = axes / np.linalg.norm(axes, axis=1, keepdims=True) * np.radians(35.0)
    return np.asarray(Rotation.from_rotvec(turns).as_matrix() @ rotation)


def find_pose(face: FacePoints, scan: Samples, scales: list[float], directions: Floats) -> Pose:
    """Return the best pose of all ``scales`` (mm per unit) and start ``directions`` (n, 3, 3)."""
    coarse = sample(scan.points, np.zeros((0, 3), np.int64), scan.normals, TREE_POINTS)
    tree = KDTree(coarse.points)
    step = len(face.points) // COARSE_POINTS
    starts = []
    for scale, direction in product(scales, directions):
        turned = scale * coarse.points @ direction.T
        for place in _nose_candidates(turned):
            shift = face.nose_tip - place
            back = (face.points[::step] - shift) @ direction / scale
            gap, near = tree.query(back, distance_upper_bound=REACH_MM / scale)
            gap = np.minimum(gap * scale, REACH_MM)
            normals = coarse.normals[np.minimum(near, len(coarse.normals) - 1)] @ direction.T
            facing = np.abs((normals * face.normals[::step]).sum(axis=1))
            cost = np.where(facing > 0.5, gap, np.minimum(gap + 10.0, REACH_MM)).mean()
            starts.append((float(cost), scale, direction, shift))
    starts.sort(key=lambda start: start[0])
    each = min(TRIED, 2 * TRIED // len(scales), 3 * len(directions))
    found = [
        (Pose(scale, direction, shift, 0.0, 0.0), scale)
        for size in scales  # at a small scale all is near: only starts of one scale compare
        for _, scale, direction, shift in [start for start in starts if start[1] == size][:each]
    ]
    for stride, iterations, kept in ((2 * step, 4, REFINED), (step, 12, FINER)):
        found = [
            (refine(face, coarse, tree, pose, size, stride, iterations), size)
            for pose, size in found
        ]
        found = sorted(found, key=lambda pair: pair[0].cost)[:kept]
    fine_tree = KDTree(scan.points)
    finer = [
        _settled(face, scan, fine_tree, refine(face, scan, fine_tree, pose, size, 1, 10), size)
        for pose, size in found
    ]
    return min(finer, key=lambda pose: pose.cost)


def is_good(pose: Pose) -> bool:
    """Return whether the pose is so good that no other start need be tried."""
    return pose.coverage > GOOD_SHARE and pose.residual_mm < GOOD_MM


def is_face(pose: Pose) -> bool:
    """Return whether what the pose found is a whole face.

    Faces of other persons, with any expression, have a cost of up to 3.2; skulls and lumpy balls
    of 4.1 and more.
    """
    return pose.coverage > FACE_SHARE and pose.cost < FACE_COST


def _nose_candidates(turned: Floats) -> Floats:
    """Return the points (k, 3) that stand out to the front from all around them, about CELL_MM."""
    cell = np.floor((turned[:, :2] - turned[:, :2].min(axis=0)) / CELL_MM).astype(np.int64)
    columns, rows = cell.max(axis=0) + 1
    number = cell[:, 0] * rows + cell[:, 1]
    order = np.lexsort((turned[:, 2], number))
    foremost = order[np.flatnonzero(np.diff(number[order], append=-1))]
    height = np.full(columns * rows, -np.inf)
    height[number[foremost]] = turned[foremost, 2]
    around = maximum_filter(height.reshape(columns, rows), 3, mode="constant", cval=-np.inf)
    stands_out = height[number[foremost]] >= around.ravel()[number[foremost]]
    return np.asarray(turned[foremost[stands_out]])


def refine(
    face: FacePoints,
    scan: Samples,
    tree: KDTree,
    start: Pose,
    size: float,
    step: int,
    iterations: int,
) -> Pose:
    """Improve a pose by iterated closest points on every ``step``-th point of the face.

    The scale stays within SIZES of ``size``.
    """
    points, normals = face.points[::step], face.normals[::step]
    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(iterations):
        back = (points - translation) @ rotation / scale
        gap, near = tree.query(back)
        facing = np.abs((scan.normals[near] @ rotation.T * normals).sum(axis=1))
        weight = gap + np.where(facing > 0.5, 0.0, np.quantile(gap, KEPT))
        kept = weight <= np.quantile(weight, KEPT)
        scale, rotation, translation = similarity(scan.points[near[kept]], points[kept])
        scale = float(np.clip(scale, size * SIZES[0], size * SIZES[1]))
        translation = points[kept].mean(0) - scale * rotation @ scan.points[near[kept]].mean(0)
    return _judged(points, normals, scan, tree, (scale, rotation, translation))


def _settled(face: FacePoints, scan: Samples, tree: KDTree, pose: Pose, size: float) -> Pose:
    """Return the pose improved by distances to planes, which lets the face slide into place.

    Linearised steps (Chen & Medioni 1992) with a seventh unknown, the scale.
    """
    scale, rotation, translation = pose.scale, pose.rotation, pose.translation
    for _ in range(SETTLING):
        back = (face.points - translation) @ rotation / scale
        gap, near = tree.query(back)
        matched = scale * scan.points[near] @ rotation.T + translation
        facing = np.abs((scan.normals[near] @ rotation.T * face.normals).sum(axis=1))
        kept = (gap <= np.quantile(gap, KEPT)) & (facing > 0.5)
        if kept.sum() < COARSE_POINTS / 2:
            break
        p, n = matched[kept], face.normals[kept]
        centre = p.mean(axis=0)
        p = p - centre
        rows = np.column_stack([np.cross(p, n), n, (p * n).sum(axis=1)])
        error = ((face.points[kept] - centre - p) * n).sum(axis=1)
        weight = 1 / np.maximum(np.abs(error), SOFT_MM)
        normal = rows.T @ (weight[:, None] * rows)
        normal += np.diag([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1.0])
        step = np.linalg.solve(normal, rows.T @ (weight * error))
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        low, high = (size * limit / scale for limit in SIZES)
        growth = float(np.clip(1 + step[6], max(low, 0.9), min(high, 1.1)))
        translation = growth * turn @ (translation - centre) + centre + step[3:6]
        rotation, scale = turn @ rotation, growth * scale
    settled = _judged(face.points, face.normals, scan, tree, (scale, rotation, translation))
    return min(pose, settled, key=lambda found: found.cost)


def _judged(
    points: Floats,
    normals: Floats,
    scan: Samples,
    tree: KDTree,
    similarity: tuple[float, Floats, Floats],
) -> Pose:
    scale, rotation, translation = similarity
    back = (points - translation) @ rotation / scale
    gap, near = tree.query(back)
    gap = gap * scale
    facing = (scan.normals[near] @ rotation.T * normals).sum(axis=1)
    if not scan.oriented:
        facing = np.abs(facing)
    close = gap < CLOSE_MM
    covered = max(close & (facing > 0.5), close & (facing < -0.5), key=np.sum)
    offsets = scale * scan.points[near] @ rotation.T + translation - points
    off_plane = np.abs((offsets * normals).sum(axis=1))
    residual = float(off_plane[covered].mean()) if covered.any() else REACH_MM
    return Pose(scale, rotation, translation, residual, float(covered.mean()))


# The unit and the axes of a raw scan, found by its face or given; its place in mm.


UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
AXES = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
FRAME = {"unit": "auto", "up": "auto", "forward": "auto"}
"""The options of every job that reads a raw scan, with their defaults."""
EXTENT_MM = (90.0, 1100.0)  # a bare face to two people's shoulders
ODD_FACTORS = (0.001, 0.1, 10.0, 1000.0)
LADDER = 1.35
SAMPLES = 20000


@dataclass(frozen=True)
class Placement:
    """A raw scan's place: mm in the subject's axes, its face over the template's.

    x_mm = rotation (mm_per_unit x) + translation. ``unit`` is None if the scan's size fits no
    unit; ``size`` is the face's size by the template's. ``up`` and ``forward`` are the axes of the
    file that come nearest to the subject's. ``pose`` is the similarity onto the template's face.
    """

    unit: str | None
    mm_per_unit: float
    up: str
    forward: str
    rotation: Floats
    translation: Floats
    size: float
    pose: Pose

    def apply(self, points: Floats) -> Floats:
        """Return points (n, 3) of the file in mm in the subject's frame."""
        return self.mm_per_unit * points @ self.rotation.T + self.translation


def face_of(template: Template) -> Surface:
    """Return the part of the template's skin that is fitted and nothing else, in its numbers."""
    skin = template.skin
    is_face = np.zeros(len(skin.vertices), bool)
    is_face[template.face_vertices] = True
    return Surface(skin.vertices, skin.faces[is_face[skin.faces].all(axis=1)])


def samples_of(scan: RawScan, count: int = SAMPLES) -> Samples:
    """Return points spread over the scan, in its own frame; what is not a number is left out."""
    finite = np.asarray(np.isfinite(scan.vertices).all(axis=1))
    vertices = np.where(finite[:, None], scan.vertices, 0.0)
    if len(scan.faces):
        return sample(vertices, scan.faces[finite[scan.faces].all(axis=1)], None, count)
    normals = None if scan.normals is None else np.nan_to_num(scan.normals[finite])
    return sample(vertices[finite], scan.faces, normals, count)


def place_samples(
    samples: Samples, face: FacePoints, frame: Mapping[str, Any], declared: float | None
) -> Placement:
    """Find the best place of the face in ``samples``, however bad, and with it unit and axes.

    ``frame`` gives ``unit``, ``up`` and ``forward`` (as :data:`FRAME`), ``declared`` the mm per
    unit that the format declares. Raises :class:`InputError`: ``options.unit``, ``options.axes``.
    """
    directions = [_within(start, frame) for start in (axis_directions(), all_directions())]
    low, high = np.quantile(samples.points, [0.005, 0.995], axis=0)
    extent = float((high - low).max())
    poses: list[Pose] = []

    def is_found(scales: list[float], starts: Floats) -> bool:
        poses.append(find_pose(face, samples, scales, starts))
        poses.sort(key=lambda pose: pose.cost)
        return is_good(poses[0])

    rounds = _scale_rounds(extent, str(frame["unit"]), declared)
    for number, scales in enumerate(rounds):
        likely = directions if number + 1 < len(rounds) else directions[:1]
        if any(is_found(scales, starts) for starts in likely):
            break
        if is_found([poses[0].scale], directions_around(poses[0].rotation)) or is_face(poses[0]):
            break
    return _placement(poses[0], face, str(frame["unit"]), declared)


def _within(directions: Floats, frame: Mapping[str, Any]) -> Floats:
    """Return those start directions (n, 3, 3) that turn the given axes about right."""
    kept = np.ones(len(directions), bool)
    for row, name in ((1, "up"), (2, "forward")):
        given = str(frame[name])
        if given == "auto":
            continue
        if given not in AXES:
            raise InputError(
                "options.axes",
                f"{name} is {given!r}, not one of auto, {', '.join(AXES)}",
                expected=["auto", *AXES],
            )
        kept &= np.asarray(directions[:, row] @ np.array(AXES[given]) > 0.8)
    if not kept.any():
        raise InputError("options.axes", "up and forward must be two different axes")
    return directions[kept]


def known_scales(extent: float, unit: str, declared: float | None) -> list[float]:
    """Return the likely mm per unit for a scan of this ``extent`` in its own unit."""
    rounds = _scale_rounds(extent, unit, declared)
    return rounds[0] if rounds else [1.0]


def _scale_rounds(extent: float, unit: str, declared: float | None) -> list[list[float]]:
    """Return lists of mm per unit to try, likelier ones first."""
    if unit != "auto" and unit not in UNITS:
        raise InputError(
            "options.unit",
            f"unit is {unit!r}, not one of auto, {', '.join(UNITS)}",
            expected=["auto", *UNITS],
        )
    first = UNITS.get(unit, declared)
    low, high = EXTENT_MM
    known = [first] if first is not None else list(UNITS.values())
    slips = {(first or 1.0) * factor for factor in ODD_FACTORS}
    odd = sorted((slips | set(UNITS.values())) - set(known))
    ladder = low / max(extent, 1e-30) * LADDER ** np.arange(np.log(high / low) / np.log(LADDER))
    rounds = [
        [scale for scale in scales if low <= scale * extent <= high]
        for scales in (known, odd, ladder.tolist())
    ]
    return [scales for scales in rounds if scales]


def _placement(pose: Pose, face: FacePoints, unit: str, declared: float | None) -> Placement:
    factor, name = unit_of(pose.scale, unit, declared)
    size = factor / pose.scale
    centre = face.points.mean(axis=0)
    file_centre = (centre - pose.translation) @ pose.rotation / pose.scale
    return Placement(
        unit=name,
        mm_per_unit=factor,
        up=_nearest_axis(pose.rotation[1]),
        forward=_nearest_axis(pose.rotation[2]),
        rotation=pose.rotation,
        translation=centre - factor * pose.rotation @ file_centre,
        size=size,
        pose=pose,
    )


PLAUSIBLE_SIZES = (0.77, 1.3)


def unit_of(scale: float, unit: str, declared: float | None) -> tuple[float, str | None]:
    """Return mm per unit and the unit's name for a fitted scale to the template.

    The given unit comes first, then the declared one, then the one that makes the likeliest size,
    then any decimal slip of one (without a name), then the template's size.
    """
    names = {factor: name for name, factor in UNITS.items()}
    first = UNITS.get(unit, declared)
    known = ([first] if first is not None else []) + list(UNITS.values())
    slips = [factor * (first or 1.0) for factor in ODD_FACTORS]
    for factor in [*known, *slips]:
        if PLAUSIBLE_SIZES[0] <= factor / scale <= PLAUSIBLE_SIZES[1]:
            return factor, names.get(factor)
    return scale, None


def _nearest_axis(direction: Floats) -> str:
    return max(AXES, key=lambda name: float(np.dot(AXES[name], direction)))
