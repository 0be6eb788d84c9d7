import numpy as np

from solver.anatomy.meshing import harmonic_displacement
from solver.anatomy.tetrahedra import background_grid


def test_linear_displacement_is_harmonic():
    points, tets = background_grid(np.zeros(3), np.full(3, 50.0), 10.0)
    held = np.flatnonzero(((points == 0) | (points == 50)).any(axis=1))
    linear = points @ np.array([[0.1, 0.2, 0], [0, -0.1, 0.3], [0.2, 0, 0.1]])
    assert np.allclose(harmonic_displacement(points, tets, held, linear[held]), linear)
