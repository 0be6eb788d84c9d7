"""A symmetric warp that keeps landmarks and soft-tissue depths."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from solver.anatomy.warp import PlaneConstraints, Warp, least_bending, spread
from solver.surface import Floats, Ints, Surface, directed_edges

# The depth of a point under the skin, and the way that leads deeper.


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


# Warps that keep landmarks and depths, on both sides alike.

MIRROR = np.array([-1.0, 1.0, 1.0])  # the mid-plane is x = 0


def both_sides(points: Floats) -> Floats:
    """Return points (n, 3) and their mirror images, (2 n, 3)."""
    return np.vstack([points, points * MIRROR])


@dataclass(frozen=True)
class PointPairs:
    """Corresponding points ``source`` and ``target``, (k, 3) in mm, of the left and the middle."""

    source: Floats
    target: Floats


@dataclass(frozen=True)
class DepthLimits:
    """Least and greatest depth in mm, (n,) or one for all, of ``points`` (n, 3) under a skin.

    The points are those of the left and the middle.
    """

    points: Floats
    least: Floats | float
    greatest: Floats | float
    skin: SkinDepth

    def corrections(self, warp: Warp) -> PlaneConstraints:
        """Return the displacements that bring the warped points back within their limits."""
        now = warp(self.points)
        depths, deeper = self.skin(now)
        missing = np.clip(depths, self.least, self.greatest) - depths
        wanted = missing + np.sum(deeper * (now - self.points), axis=1)
        active = missing != 0
        return PlaneConstraints(self.points[active], deeper[active], wanted[active])


def depth_warp(
    landmarks: PointPairs,
    limits: list[DepthLimits],
    *,
    centres: int,
    stiffness: float,
    steps: int = 14,
) -> Warp:
    """Return the least bending warp that meets landmarks and depth limits (Gauss-Newton).

    Each of the ``steps`` linearises the depths of the points that violate their limits. What is
    given for the left also holds for the right, mirrored at x = 0: the warp is symmetric. It has
    ``centres`` on the left and as many on the right; more ``stiffness`` misses what is wanted by
    more, less folds space.
    """
    everything = np.vstack([landmarks.source, *[limit.points for limit in limits]])
    kernels = both_sides(everything[spread(everything, centres)])
    fixed = PlaneConstraints(
        np.repeat(landmarks.source, 3, axis=0),
        np.tile(np.eye(3), (len(landmarks.source), 1)),
        (landmarks.target - landmarks.source).ravel(),
    )
    warp = Warp(kernels, np.zeros((len(kernels) + 4, 3)))
    for _ in range(steps):
        parts = [fixed, *[limit.corrections(warp) for limit in limits]]
        planes = PlaneConstraints(
            both_sides(np.vstack([part.points for part in parts])),
            both_sides(np.vstack([part.directions for part in parts])),
            np.tile(np.concatenate([part.distances for part in parts]), 2),
        )
        warp = least_bending(kernels, planes, stiffness)
    return warp
