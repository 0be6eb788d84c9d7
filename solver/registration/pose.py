"""Where the face is in a scan of any pose: a search over the whole surface, without landmarks.

The nose tip is put on many places of the scan with many turns about the surface normal; each of
these poses is improved by a few steps of trimmed closest points (Besl & McKay 1992; Chetverikov et
al. 2005), and the best of them by more steps with more points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.warp import spread
from solver.registration.scan_surface import ScanSurface
from solver.similarity import Similarity
from solver.surface import Floats, Ints

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
