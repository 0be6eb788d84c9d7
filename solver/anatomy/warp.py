"""Smooth maps of space: the kernel |r| with an affine part, from points or depths under a skin.

In three dimensions |r| is the kernel of the biharmonic spline (Bookstein 1989; Carr et al. 2001):
among all maps through the given points it bends least.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from solver.surface import Floats, Ints, Surface, inside


@dataclass(frozen=True)
class Warp:
    """x -> x + sum_k |x - centre_k| w_k + [x 1] A."""

    centres: Floats  # (k, 3)
    coefficients: Floats  # (k + 4, 3) rows w_k, then A

    def __call__(self, points: Floats) -> Floats:
        """Return the images (n, 3) of ``points`` (n, 3)."""
        return points + basis(points, self.centres) @ self.coefficients


def basis(points: Floats, centres: Floats) -> Floats:
    """Return the (n, k + 4) values of all kernels and of the affine part at ``points``."""
    affine = np.column_stack([points, np.ones(len(points))])
    return np.hstack([cdist(points, centres), affine])


def interpolate(source: Floats, target: Floats, smoothing: float = 0.0) -> Warp:
    """Return the warp that takes ``source`` (k, 3) to ``target`` (k, 3).

    ``smoothing`` in mm lets it miss the targets for less bending; zero goes through them.
    """
    count = len(source)
    values = basis(source, source)
    # -|r| is conditionally positive definite, hence the sign of the smoothing term.
    values[:, :count] -= smoothing * np.eye(count)
    matrix = np.vstack([values, np.pad(values[:, count:].T, ((0, 0), (0, 4)))])
    right = np.vstack([target - source, np.zeros((4, 3))])
    return Warp(source, solve(matrix, right, assume_a="sym"))


def spread(points: Floats, count: int, first: int = 0, density: Floats | float = 1.0) -> Ints:
    """Return the numbers of ``count`` points far from each other, from number ``first`` on.

    Farthest-point sampling; where ``density`` (n,) is 2, they are half as far apart as at 1.
    """
    chosen = np.full(min(count, len(points)), first)
    distance = np.full(len(points), np.inf)
    for k in range(1, len(chosen)):
        away = density * np.linalg.norm(points - points[chosen[k - 1]], axis=1)
        np.minimum(distance, away, out=distance)
        chosen[k] = int(np.argmax(distance))
    return chosen


@dataclass(frozen=True)
class PlaneConstraints:
    """Wanted displacements of points along directions: direction_i . u(point_i) = distance_i."""

    points: Floats  # (n, 3)
    directions: Floats  # (n, 3) unit
    distances: Floats  # (n,) in mm


def least_bending(centres: Floats, planes: PlaneConstraints, stiffness: float) -> Warp:
    """Return the warp that meets ``planes`` in least squares, with ``stiffness`` x bending energy.

    Three plane constraints along the axes fix a point; one slides on a surface.
    """
    count = len(centres)
    polynomial = np.column_stack([centres, np.ones(count)])
    # Kernel weights orthogonal to affine maps: there the bending energy is positive definite.
    complement = np.linalg.qr(polynomial, mode="complete")[0][:, 4:]
    bending = -complement.T @ cdist(centres, centres) @ complement
    values = basis(planes.points, centres)
    values = np.hstack([values[:, :count] @ complement, values[:, count:]])
    rows = np.einsum("nd,nk->ndk", planes.directions, values).reshape(len(values), -1)
    root = np.linalg.cholesky(bending + 1e-9 * np.trace(bending) / count * np.eye(count - 4)).T
    regular = np.kron(np.eye(3), np.hstack([np.sqrt(stiffness) * root, np.zeros((count - 4, 4))]))
    normal = rows.T @ rows + regular.T @ regular
    right = rows.T @ planes.distances
    normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
    solution = solve(normal, right, assume_a="pos").reshape(3, -1).T
    coefficients = np.vstack([complement @ solution[: count - 4], solution[count - 4 :]])
    return Warp(centres, coefficients)


class SkinDepth:
    """Signed distance to a skin whose holes (mouth, lids, neck) are closed by fans.

    With open holes the teeth would count as outside: ``closed`` is the skin without. Distances may
    be taken to a part of the skin only, ``nearest`` (f, 3).
    """

    def __init__(self, skin: Surface, nearest: Ints | None = None) -> None:
        self.closed = close_holes(skin)
        self._nearest = skin.faces if nearest is None else nearest
        self._tree = igl.AABB()
        self._tree.init(self.closed.vertices, self._nearest)

    def __call__(self, points: Floats) -> tuple[Floats, Floats]:
        """Return depths (n,) in mm, negative outside, and unit directions (n, 3) that go deeper."""
        squared, _, closest = self._tree.squared_distance(
            self.closed.vertices, self._nearest, points
        )
        away = points - closest
        distance = np.sqrt(squared)
        sign = np.where(inside(self.closed, points), 1.0, -1.0)
        direction = sign[:, None] * away / np.maximum(distance, 1e-9)[:, None]
        return sign * distance, direction


def close_holes(surface: Surface, bare_mm: float = 100.0) -> Surface:
    """Return a surface with a fan of triangles over every hole, around its middle.

    One that is wider than ``bare_mm`` and looks back is that of a bare face: a cone as long as it
    is wide has room for the head behind it.
    """
    vertices, (edges, hole) = surface.vertices, boundary_edges(surface.faces)
    # Turned round, the edges of a hole and its middle make faces that close it.
    caps = np.column_stack([edges[:, ::-1], len(vertices) + hole])
    centres = []
    for rim in (vertices[edges[hole == number]] for number in np.unique(hole)):
        middle = rim[:, 0].mean(axis=0)
        width = float(np.ptp(rim[:, 0], axis=0).max())
        out = np.cross(rim[:, 1] - middle, rim[:, 0] - middle).sum(axis=0)
        out /= np.linalg.norm(out) + 1e-30
        looks_back = width > bare_mm and -out[2] > np.abs(out[:2]).max()
        centres.append(middle + width * out if looks_back else middle)
    return Surface(np.vstack([vertices, *centres]), np.vstack([surface.faces, caps]))


def boundary_edges(faces: Ints) -> tuple[Ints, Ints]:
    """Return the edges (e, 2) of only one face, in its direction, and the hole (e,) of each."""
    edges = np.asarray(igl.boundary_facets(faces)[0]).reshape(-1, 2)
    graph = sp.coo_array((np.ones(len(edges)), edges.T), shape=(int(faces.max()) + 1,) * 2)
    piece = connected_components(graph, directed=False)[1]
    return edges, np.unique(piece[edges[:, 0]], return_inverse=True)[1]


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

    Each of the ``steps`` linearises the depths of the points that violate their limits. Landmarks
    and limits of the left also hold on the right, mirrored at x = 0: the warp is symmetric. It has
    ``centres`` on the left and as many on the right; more ``stiffness`` misses the landmarks by
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
