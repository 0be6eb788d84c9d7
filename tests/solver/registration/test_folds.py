"""A triangle that registration turned over is laid flat, and nothing else moves."""

import numpy as np

from solver.registration.nonrigid import folded_triangles, unfold


def test_a_vertex_pushed_over_its_neighbour_comes_back():
    side = 9
    x, y = np.meshgrid(np.arange(side, dtype=float), np.arange(side, dtype=float))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    corner = np.array([row * side + k for row in range(side - 1) for k in range(side - 1)])
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + side + 1], axis=1),
            np.stack([corner, corner + side + 1, corner + side], axis=1),
        ]
    )
    moved = flat + np.array([0.0, 0.0, 2.0])
    pushed = moved.copy()
    pushed[4 * side + 4, :2] += (1.6, 0.3)
    assert len(folded_triangles(flat, pushed, faces)) > 0
    mended = unfold(flat, pushed, faces)
    assert len(folded_triangles(flat, mended, faces)) == 0
    far = np.linalg.norm(flat[:, :2] - 4, axis=1) > 3.5
    np.testing.assert_array_equal(mended[far], pushed[far])
    np.testing.assert_allclose(mended, moved, atol=0.6)
