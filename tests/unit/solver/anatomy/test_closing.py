import numpy as np
import pytest

from solver.anatomy.closing import harmonic_displacement, untangled
from solver.anatomy.tetrahedra import background_grid, volumes


@pytest.fixture
def block():
    points, tets = background_grid(np.zeros(3), np.full(3, 50.0), 10.0)
    held = np.flatnonzero(((points == 0) | (points == 50)).any(axis=1))
    return points, tets, held


def test_linear_displacement_is_harmonic(block):
    points, tets, held = block
    linear = points @ np.array([[0.1, 0.2, 0], [0, -0.1, 0.3], [0.2, 0, 0.1]])
    assert np.allclose(harmonic_displacement(points, tets, held, linear[held]), linear)


def test_inverted_tets_are_untangled_and_held_vertices_stay(block):
    points, tets, held = block
    moved = points.copy()
    inner = int(np.argmin(np.linalg.norm(points - 20.0, axis=1)))
    moved[inner] += [22.0, 3.0, -4.0]
    assert volumes(moved, tets).min() < 0
    result = untangled(points, moved, tets, held)
    assert volumes(result, tets).min() > 0
    assert np.array_equal(result[held], points[held])


def test_valid_pose_is_returned_unchanged(block):
    points, tets, held = block
    moved = points * [1.0, 0.9, 1.05]
    assert np.array_equal(untangled(points, moved, tets, held), moved)
