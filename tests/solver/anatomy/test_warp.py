import numpy as np
import pytest

from solver.anatomy.warp import PlaneConstraints, interpolate, least_bending, spread
from solver.similarity import fit_similarity


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-50, 50, (60, 3))


def test_similarity_is_recovered(points):
    angle = 0.3
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    found = fit_similarity(points, 1.1 * points @ rotation.T + [1, 2, 3])
    assert found.scale == pytest.approx(1.1)
    assert np.allclose(found.rotation, rotation)
    assert np.allclose(found.shift, [1, 2, 3])


def test_warp_goes_through_its_points_and_keeps_affine_maps(points):
    target = points + np.sin(points[:, ::-1] / 20)
    assert np.allclose(interpolate(points, target)(points), target)
    matrix = np.array([[1.1, 0.2, 0], [0, 0.9, 0.1], [0.05, 0, 1]])
    affine = interpolate(points, points @ matrix.T + 3)
    elsewhere = np.random.default_rng(1).uniform(-90, 90, (20, 3))
    assert np.allclose(affine(elsewhere), elsewhere @ matrix.T + 3)


def test_plane_constraint_leaves_the_other_directions_free(points):
    up = np.tile([0.0, 1.0, 0.0], (len(points), 1))
    wanted = 0.1 * points[:, 1] + 2
    warp = least_bending(points, PlaneConstraints(points, up, wanted), 0.1)
    moved = warp(points) - points
    assert np.allclose(moved[:, 1], wanted, atol=1e-3)
    assert np.abs(moved[:, [0, 2]]).max() < 1e-3


def test_spread_is_denser_where_it_should_be_and_begins_where_it_should():
    line = np.linspace(0.0, 100.0, 401)[:, None] * [1.0, 0.0, 0.0]
    density = np.where(line[:, 0] > 50.0, 3.0, 1.0)
    chosen = spread(line, 40, 200, density)
    assert chosen[0] == 200
    right = (chosen > 200).sum()
    assert 2.5 < right / (40 - right) < 3.5
    assert np.array_equal(chosen[:10], spread(line, 10, 200, density))


def test_spread_takes_the_corners_of_a_line_first():
    line = np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])
    assert set(spread(line, 3)) == {0, 10, 5}
