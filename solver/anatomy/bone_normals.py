"""Normals of the bone surface under vertices of the flesh."""

from __future__ import annotations

import igl
import numpy as np

from solver.normals import vertex_normals
from solver.surface import Floats, Surface


def bone_normals(bone: Surface, points: Floats) -> Floats:
    """Return the bone's unit normals, (k, 3), where it is nearest to ``points`` (k, 3).

    Normals of vertices are blended over a triangle, so that neighbours slide alike.
    """
    tree = igl.AABB()
    tree.init(bone.vertices, bone.faces)
    _, face, nearest = tree.squared_distance(bone.vertices, bone.faces, points)
    corners = bone.faces[face]
    shares = igl.barycentric_coordinates(nearest, *bone.vertices[corners].transpose(1, 0, 2))
    normals = (vertex_normals(bone)[corners] * shares[:, :, None]).sum(axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
