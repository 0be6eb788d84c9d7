"""How deep a point lies under the skin, and which way is deeper."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from solver.surface import Floats, Ints, Surface
from solver.triangles import directed_edges


class SkinDepth:
    """Signed distance to a skin whose holes (mouth, lids, neck) are closed by fans.

    With open holes the teeth would count as outside. Distances may be taken to a part of the skin
    only, ``nearest`` (f, 3).
    """

    def __init__(self, skin: Surface, nearest: Ints | None = None) -> None:
        edges, hole = boundary_edges(skin.faces)
        centres = [
            skin.vertices[np.unique(edges[hole == number])].mean(axis=0, keepdims=True)
            for number in np.unique(hole)
        ]
        # Turned round, the edges of a hole and its middle make faces that close it.
        caps = np.column_stack([edges[:, ::-1], len(skin.vertices) + hole])
        self._vertices = np.vstack([skin.vertices, *centres])
        self._faces = np.vstack([skin.faces, caps])
        self._skin = skin.faces if nearest is None else nearest
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._skin)

    def inside(self, points: Floats) -> np.ndarray:
        """Return (n,) True where a point is under the skin."""
        winding = igl.fast_winding_number(self._vertices, self._faces, points)
        return np.asarray(winding) > 0.5

    def __call__(self, points: Floats) -> tuple[Floats, Floats]:
        """Return depths (n,) in mm, negative outside, and unit directions (n, 3) that go deeper."""
        squared, _, closest = self._tree.squared_distance(self._vertices, self._skin, points)
        away = points - closest
        distance = np.sqrt(np.asarray(squared).ravel())
        sign = np.where(self.inside(points), 1.0, -1.0)
        direction = sign[:, None] * away / np.maximum(distance, 1e-9)[:, None]
        return sign * distance, direction


def boundary_edges(faces: Ints) -> tuple[Ints, Ints]:
    """Return the edges (e, 2) of only one face, in its direction, and the hole (e,) of each."""
    edges = directed_edges(faces)
    _, edge, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    edges = edges[count[edge.ravel()] == 1]
    numbers, local = np.unique(edges, return_inverse=True)
    local = local.reshape(-1, 2)
    graph = sp.coo_array((np.ones(len(edges)), local.T), shape=(len(numbers), len(numbers)))
    _, hole = connected_components(graph, directed=False)
    return edges, hole[local[:, 0]].astype(np.int64)
