import numpy as np
import pytest
import trimesh

from solver.anatomy.warp import SkinDepth, boundary_edges
from solver.surface import Surface


@pytest.fixture
def bowl():
    """Return a ball with a hole around its north pole."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    centres = mesh.triangles_center
    faces = mesh.faces[centres[:, 1] < 40]
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(np.asarray(mesh.vertices)[used], faces.reshape(-1, 3).astype(np.int64))


def test_hole_is_found_once(bowl):
    edges, hole = boundary_edges(bowl.faces)
    assert (hole == 0).all()
    assert np.array_equal(np.sort(edges[:, 0]), np.sort(edges[:, 1]))
    assert np.abs(bowl.vertices[edges, 1] - 40).max() < 5


def test_depth_is_signed_and_its_direction_goes_deeper(bowl):
    points = np.array([[40.0, 0, 0], [60.0, 0, 0], [0, -45.0, 0]])
    depth, deeper = SkinDepth(bowl)(points)
    assert depth == pytest.approx([10, -10, 5], abs=0.3)
    again, _ = SkinDepth(bowl)(points + deeper)
    assert again == pytest.approx(depth + 1, abs=0.1)


def test_point_over_the_closed_hole_is_outside(bowl):
    assert SkinDepth(bowl)(np.array([[0, 48.0, 0]]))[0] < 0
    assert SkinDepth(bowl)(np.array([[0, 30.0, 0]]))[0] > 0


def test_head_behind_a_bare_face_is_inside() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=90.0)
    front = ball.faces[ball.triangles_center[:, 2] > 20]
    used, faces = np.unique(front, return_inverse=True)
    face = Surface(np.asarray(ball.vertices)[used], faces.reshape(-1, 3).astype(np.int64))
    depth = SkinDepth(face)(np.array([[0, 0, -30.0], [60.0, 0, 0], [0, 0, 100.0]]))[0]
    assert (depth[:2] > 0).all()  # behind the rim, at z = 20
    assert depth[2] < 0
