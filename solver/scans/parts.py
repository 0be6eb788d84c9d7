"""More or less than one face in a scan: a second head, or only a part of a face."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from solver.scans.pose import (
    FacePoints,
    Pose,
    axis_directions,
    find_pose,
    is_face,
)
from solver.scans.sample import Samples
from solver.surface import Surface

PART_SHARE, PART_COST = 0.8, 2.35
"""Halves of other persons' faces cost up to 2.2; skulls and balls 2.5 and more where one is."""
NOTHING_MM = 18.0
OPPOSITE = {"left": "right", "right": "left", "upper": "lower", "lower": "upper"}
OTHER_SHARE = 0.08
HEAD_MM = np.array([[-95.0, -210.0, -220.0], [95.0, 190.0, 120.0]])
"""The box about a face's middle that its own head fills."""


def parts_of(face: Surface) -> dict[str, FacePoints]:
    """Return the ``left``, ``right``, ``upper`` and ``lower`` halves of a template's face."""
    centre = face.vertices[face.faces].mean(axis=1)
    middle = np.median(centre[:, 1])
    halves = {
        "left": centre[:, 0] > 0,
        "right": centre[:, 0] < 0,
        "upper": centre[:, 1] > middle,
        "lower": centre[:, 1] < middle,
    }
    return {
        name: FacePoints(Surface(face.vertices, face.faces[kept])) for name, kept in halves.items()
    }


def visible_part(scan: Samples, face: Surface, scales: list[float]) -> str | None:
    """Return which half of a face a scan shows that shows no whole one; else None."""
    parts = parts_of(face)
    best: tuple[str, Pose] | None = None
    for name, part in parts.items():
        pose = find_pose(part, scan, scales, axis_directions())
        is_part = pose.coverage > PART_SHARE and pose.cost < PART_COST
        is_better = best is None or pose.cost < best[1].cost
        if is_part and is_better and _is_absent(parts[OPPOSITE[name]], scan, pose):
            best = name, pose
    return None if best is None else best[0]


def _is_absent(part: FacePoints, scan: Samples, pose: Pose) -> bool:
    """Return whether most of a part of the face has nothing of the scan about it."""
    gap, _ = KDTree(pose.apply(scan.points)).query(part.points)
    return bool((gap > NOTHING_MM).mean() > 0.5)


def has_second_face(scan: Samples, face: FacePoints, pose: Pose) -> bool:
    """Return whether there is another face in the scan than the one at ``pose``."""
    there = pose.apply(scan.points) - face.points.mean(axis=0)
    outside = ((there < HEAD_MM[0]) | (there > HEAD_MM[1])).any(axis=1)
    if outside.sum() < OTHER_SHARE * len(outside):
        return False
    rest = Samples(scan.points[outside], scan.normals[outside], scan.oriented)
    directions = np.concatenate([pose.rotation[None], axis_directions() @ pose.rotation])
    return is_face(find_pose(face, rest, [pose.scale], directions))
