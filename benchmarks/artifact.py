"""An artifact no face can make: a bump on the cheek, and how far a fit follows it.

A model that has learned how a face moves leaves an artifact alone; one that can reach anything
follows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, vertex_normals

HEIGHT_MM = 6.0
RADIUS_MM = 8.0


@dataclass(frozen=True)
class Bump:
    """A bump on a scan: ``heights`` (k,) in mm at ``vertices`` (k,), along unit ``normals``."""

    vertices: Ints
    heights: Floats
    normals: Floats


def add_bump(
    scan: Surface, centre: int, height: float = HEIGHT_MM, radius: float = RADIUS_MM
) -> tuple[Surface, Bump]:
    """Return a scan with a smooth bump around vertex ``centre``, along the scan's normals.

    Its height is ``height`` (1 - d^2 / ``radius``^2)^2 at a distance d of the centre, in mm.
    """
    distance = np.linalg.norm(scan.vertices - scan.vertices[centre], axis=1)
    vertices = np.flatnonzero(distance < radius)
    heights = height * (1.0 - (distance[vertices] / radius) ** 2) ** 2
    normals = vertex_normals(scan)[vertices]
    moved = scan.vertices.copy()
    moved[vertices] += heights[:, None] * normals
    return scan.with_vertices(moved), Bump(vertices, heights, normals)


def cheek(model: SubjectModel) -> int:
    """Return the vertex of the face skin in the middle of the left cheek's front half."""
    cheeks = np.intersect1d(model.regions["cheeks"], model.face)
    left = cheeks[model.skin.vertices[cheeks, 0] > 0.0]
    depth = model.skin.vertices[left, 2]
    front = left[depth >= np.median(depth)]
    points = model.skin.vertices[front]
    return int(front[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))])


def followed(bump: Bump, without: Floats, with_bump: Floats) -> float:
    """Return what part of a bump a fit follows: 0 none of it, 1 all.

    ``without`` and ``with_bump`` (V, 3) are the fitted skins in the scan's topology, without and
    with the bump in the scan. It is the mean displacement along the bump over the bump's mean
    height, both weighted by the height.
    """
    motion = (with_bump - without)[bump.vertices]
    along = np.sum(motion * bump.normals, axis=1)
    return float(bump.heights @ along / (bump.heights @ bump.heights))
