"""Normals of a bone where flesh slides on it."""

import numpy as np
import trimesh

from solver.anatomy.bones import bone_normals
from solver.surface import Surface


def test_normals_of_a_ball_point_away_from_its_centre():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=30.0)
    points = np.random.default_rng(0).standard_normal((50, 3))
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    normals = bone_normals(Surface(np.asarray(ball.vertices), np.asarray(ball.faces)), 33 * outward)
    assert (normals * outward).sum(axis=1).min() > 0.999
