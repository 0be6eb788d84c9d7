"""A skin subdivided smoothly, as programs do that displace it, with the skin's places on it."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from solver.surface import Floats, Ints, Surface

CHILDREN = 4  # triangles that each is divided into: at its three corners, and the middle one third
CORNERS = (0, 1, 3)  # numbers of those at the corners
MIDDLE = 2  # number of the one between them
MATRICES = np.array(  # of the children's barycentric shares by the triangle's
    [
        [[1, -1, -1], [0, 2, 0], [0, 0, 2]],
        [[-1, 1, -1], [0, 0, 2], [2, 0, 0]],
        [[1, 1, -1], [-1, 1, 1], [1, -1, 1]],
        [[0, 2, 0], [-1, -1, 1], [2, 0, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, eq=False)
class Subdivided:
    """A skin after some ``levels`` of Loop's subdivision (Loop 1987)."""

    surface: Surface
    levels: int

    @classmethod
    def of(cls, skin: Surface, levels: int) -> Subdivided:
        """Return a skin whose triangles are divided in four ``levels`` times, and smoothed."""
        vertices, faces = igl.loop(skin.vertices, skin.faces, levels)
        return cls(Surface(np.asarray(vertices), np.asarray(faces, np.int64)), levels)

    def locate(self, faces: Ints, shares: Floats) -> tuple[Ints, Floats]:
        """Return triangles (n,) and shares (n, 3) of what were those of the skin."""
        for _ in range(self.levels):
            child = np.full(len(faces), MIDDLE)
            row, corner = np.nonzero(shares >= 0.5)
            child[row] = np.take(CORNERS, corner)
            shares = np.einsum("nij,nj->ni", MATRICES[child], shares)
            faces = CHILDREN * faces + child
        return faces, shares
