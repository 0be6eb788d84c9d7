"""Tangents of a skin by its texture coordinates: the axes in which normal maps are written.

A tangent points to where the first coordinate grows, as MikkTSpace has it (Mikkelsen, "Simulation
of wrinkled surfaces revisited", 2008), which glTF asks of viewers: in each corner the triangle's
direction is laid into the plane of the vertex's normal, and the mean over the corners is weighted
by their angles. The third axis is the normal n, the second w n x t, with w = -1 where the image
lies mirrored on the skin.
"""

from __future__ import annotations

import numpy as np

from solver.surface import Floats, Ints, unit_rows


def vertex_tangents(points: Floats, normals: Floats, places: Floats, faces: Ints) -> Floats:
    """Return unit tangents with their w (k, 4) at vertices with one place in the image each.

    ``points`` and unit ``normals`` are (k, 3), ``places`` (k, 2) count from the image's lower left
    corner. A vertex without any area in the image has some direction across its normal.
    """
    along = _edges(places[faces])
    across = _edges(points[faces])
    area = along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0]
    side = np.where(area < 0.0, -1.0, 1.0)
    direction = along[:, 1, 1, None] * across[:, 0] - along[:, 0, 1, None] * across[:, 1]
    direction *= np.where(area == 0.0, 0.0, side)[:, None]
    sums = np.zeros((len(points), 3))
    sides = np.zeros(len(points))
    for corner in range(3):
        vertex = faces[:, corner]
        normal = normals[vertex]
        one, other = (
            unit_rows(_into_plane(points[faces[:, (corner + step) % 3]] - points[vertex], normal))
            for step in (1, 2)
        )
        angle = np.arccos(np.clip(np.einsum("nd,nd->n", one, other), -1.0, 1.0))
        np.add.at(sums, vertex, angle[:, None] * unit_rows(_into_plane(direction, normal)))
        np.add.at(sides, vertex, angle * side)
    lost = np.linalg.norm(sums, axis=1) < 1e-9
    least = np.eye(3)[np.abs(normals[lost]).argmin(axis=1)]
    sums[lost] = _into_plane(least, normals[lost])
    return np.column_stack([unit_rows(sums), np.where(sides < 0.0, -1.0, 1.0)])


def frames(tangents: Floats, normals: Floats) -> Floats:
    """Return unit axes (n, 3, 3), rows t, w n x t and n, of interpolated tangents and normals.

    ``tangents`` (n, 4) and ``normals`` (n, 3) are as between vertices, of any length.
    """
    third = unit_rows(normals)
    first = unit_rows(_into_plane(tangents[:, :3], third))
    second = np.where(tangents[:, 3:] < 0.0, -1.0, 1.0) * np.cross(third, first)
    return np.stack([first, second, third], axis=1)


def _edges(corners: Floats) -> Floats:
    """Return both edges (f, 2, d) from the first of the corners (f, 3, d)."""
    return np.asarray(corners[:, 1:] - corners[:, :1])


def _into_plane(vectors: Floats, normals: Floats) -> Floats:
    return np.asarray(vectors - np.einsum("nd,nd->n", vectors, normals)[:, None] * normals)
