"""A block of tets, tangled or squeezed, pulled back to its sides."""

import numpy as np
import pytest

from solver.anatomy.tetrahedra import background_grid, dihedral_angles, volumes
from solver.anatomy.transfer import Guides, _shape_energy, relax


@pytest.fixture(scope="module")
def block():
    points, tets = background_grid(np.zeros(3), np.full(3, 50.0), 10.0)
    sides = np.flatnonzero(((points == 0) | (points == 50)).any(axis=1))
    return points, tets, Guides.of_vertices(sides, points[sides], 10.0, len(points))


def test_inverted_tets_are_untangled_and_sides_stay(block):
    points, tets, guides = block
    tangled = points.copy()
    inner = int(np.argmin(np.linalg.norm(points - 20.0, axis=1)))
    tangled[inner] += [22.0, 3.0, -4.0]
    assert volumes(tangled, tets).min() < 0
    result = relax(tangled, tets, guides)
    assert volumes(result, tets).min() > 0
    assert dihedral_angles(result, tets).min() > 20
    assert np.abs(guides.rows @ result - guides.targets).max() < 0.5


def test_the_same_start_gives_the_same_bits(block):
    points, tets, guides = block
    start = points + np.random.default_rng(0).normal(0, 1.0, points.shape)
    assert np.array_equal(relax(start, tets, guides), relax(start, tets, guides))


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_shape_energy_has_its_derivative(smoothing):
    points = np.random.default_rng(1).normal(size=(4, 3))
    tets = np.array([[0, 1, 2, 3]])
    if smoothing == 0.0 and volumes(points, tets)[0] < 0:
        tets = tets[:, [1, 0, 2, 3]]
    one = np.ones(1)
    step = 1e-6
    gradient = np.zeros((4, 3))
    differences = np.zeros((4, 3))
    _shape_energy(points, tets, one, smoothing, gradient)
    for place in np.ndindex(4, 3):
        for sign in (1, -1):
            moved = points.copy()
            moved[place] += sign * step
            energy = _shape_energy(moved, tets, one, smoothing, np.zeros((4, 3)))
            differences[place] += sign * energy / (2 * step)
    assert np.allclose(gradient, differences, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())
