"""Boxes of tetrahedra, whose deformations are known."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from solver.surface import Floats, Ints


def box(cells: tuple[int, int, int], size_mm: tuple[float, float, float]) -> tuple[Floats, Ints]:
    """Return vertices (p, 3) and tets (n, 4) of a box: each cube of its ``cells`` is cut in six.

    A tet of Kuhn's division goes from a cube's first corner to its last, one axis after another.
    """
    counts = np.array(cells) + 1
    corners = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([counts[1] * counts[2], counts[2], 1])
    first = corners[(corners < cells).all(axis=1)] @ stride
    tets = []
    for axes in permutations(range(3)):
        path = np.cumsum([0, *stride[list(axes)]])
        even = np.linalg.det(np.eye(3)[list(axes)]) > 0.0
        tets.append(first[:, None] + (path if even else path[[0, 2, 1, 3]]))
    return corners / cells * np.array(size_mm), np.concatenate(tets)
