import numpy as np
import pytest
import trimesh

from solver.anatomy.tetrahedra import (
    EdgeLengths,
    background_grid,
    dihedral_angles,
    tetrahedralize,
    volumes,
)
from solver.errors import SolveError
from solver.surface import Surface


def ball(radius, subdivisions=2):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))


def lengths(edge):
    points, tets = background_grid(np.full(3, -20.0), np.full(3, 20.0), 10.0)
    return EdgeLengths(points, tets, np.full(len(points), edge))


def test_background_grid_fills_its_box():
    points, tets = background_grid(np.zeros(3), np.array([20.0, 10.0, 30.0]), 10.0)
    sizes = volumes(points, tets)
    assert sizes.min() > 0
    assert sizes.sum() == pytest.approx(20 * 10 * 30)


def test_ball_is_filled_without_inverted_tets():
    surface = ball(15.0)
    vertices, tets = tetrahedralize(
        surface, 8.0, envelope_mm=0.5, lengths=lengths(8.0), cpu_seconds=120
    )
    sizes = volumes(vertices, tets)
    assert sizes.min() > 0
    inside = np.linalg.norm(vertices[tets].mean(axis=1), axis=1) < 14.5
    expected = trimesh.Trimesh(surface.vertices, surface.faces).volume
    assert sizes[inside].sum() == pytest.approx(expected, rel=0.1)
    assert dihedral_angles(vertices, tets).min() > 3


def test_mesher_that_does_not_come_back_is_ended():
    with pytest.raises(SolveError) as caught:
        tetrahedralize(ball(15.0), 8.0, envelope_mm=0.5, lengths=lengths(8.0), cpu_seconds=0.05)
    assert caught.value.code == "mesher.timeout"


def test_mesher_that_dies_is_an_error_with_its_last_words():
    bad = EdgeLengths(*background_grid(np.zeros(3), np.ones(3), 1.0), np.full(8, -1.0))
    with pytest.raises(SolveError, match="positive") as caught:
        tetrahedralize(ball(15.0), 8.0, envelope_mm=0.5, lengths=bad, cpu_seconds=120)
    assert caught.value.code == "mesher.crashed"


def test_dihedral_angle_of_a_regular_tetrahedron():
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    angle = dihedral_angles(corners, np.array([[0, 1, 2, 3]])).min()
    assert angle == pytest.approx(np.degrees(np.arccos(1 / 3)))
