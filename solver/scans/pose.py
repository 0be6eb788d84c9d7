"""Where a face is in a scan, at any place, in any direction and unit.

Many starts (directions x places of the nose tip) are scored on a few points, the best are refined
by iterated closest points (Besl & McKay 1992) with a similarity (Umeyama 1991), trimmed so that
hair, shoulders and holes do not pull (Chetverikov et al. 2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from solver.anatomy.warp import similarity
from solver.scans.sample import Samples, sample
from solver.surface import Floats, Surface

COARSE_POINTS, FINE_POINTS = 160, 1200
TREE_POINTS = 6000
REACH_MM = 30.0  # what is farther from the face than this is not there
CELL_MM = 22.0
CLOSE_MM = 8.0
TRIED, REFINED, FINER = 250, 36, 5
SETTLING = 12
SOFT_MM = 0.5
UNCOVERED_MM = 10.0
KEPT = 0.75
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
