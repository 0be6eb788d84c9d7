"""Points spread evenly over a scan, with normals: what poses and fits are found from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from solver.surface import Floats, Ints
from solver.triangles import area_normals

NEIGHBOURS = 12


@dataclass(frozen=True)
class Samples:
    """Points (n, 3) with unit normals (n, 3), whose signs mean nothing unless ``oriented``."""

    points: Floats
    normals: Floats
    oriented: bool

    def moved(self, scale: float, rotation: Floats, translation: Floats) -> Samples:
        """Return the samples in another frame: x -> scale * rotation x + translation."""
        points = scale * self.points @ rotation.T + translation
        return Samples(points, self.normals @ rotation.T, self.oriented)


def sample(
    vertices: Floats, faces: Ints, normals: Floats | None, count: int, seed: int = 0
) -> Samples:
    """Return about ``count`` points, spread by area over triangles or by space over a cloud.

    All vertices must be finite. Without faces or ``normals`` the normals are found from the
    neighbours, and their signs mean nothing.
    """
    rng = np.random.default_rng(seed)
    if len(faces):
        return _on_triangles(vertices, faces, count, rng)
    chosen = _spread(vertices, count, rng)
    points = vertices[chosen]
    if normals is not None:
        return Samples(points, _unit(normals[chosen]), True)
    return Samples(points, estimated_normals(points, vertices), False)


def _on_triangles(vertices: Floats, faces: Ints, count: int, rng: np.random.Generator) -> Samples:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = area_normals(vertices, faces)
    area = np.linalg.norm(cross, axis=1)
    ends = np.cumsum(area)
    if ends[-1] <= 0:
        return Samples(vertices[:1], np.array([[0.0, 0.0, 1.0]]), False)
    steps = (np.arange(count) + rng.random(count)) / count
    chosen = np.minimum(np.searchsorted(ends, steps * ends[-1]), len(faces) - 1)
    u, v = rng.random((2, count, 1))
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return Samples(points, _unit(cross[chosen]), True)


def _spread(points: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Return the numbers of one random point of each cube of a grid with about ``count`` cubes."""
    if len(points) <= count:
        return np.arange(len(points))
    order = rng.permutation(len(points))
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    size = float((high - low).max())
    cells = np.sqrt(count / 2)  # a surface in a cube of n cells a side passes about 2 n^2 of them
    for _ in range(4):
        numbers = np.floor((points[order] - low) / (size / cells + 1e-30)).astype(np.int64)
        keys = (numbers * np.array([1, 1_000_003, 1_000_003**2])).sum(axis=1)
        _, first = np.unique(keys, return_index=True)
        if 0.7 < len(first) / count < 1.4:
            break
        cells *= np.sqrt(count / len(first))
    return np.asarray(order[np.sort(first)[:count]], np.int64)


def estimated_normals(points: Floats, cloud: Floats) -> Floats:
    """Return normals (n, 3), of either sign, of planes through the neighbours in ``cloud``."""
    tree = KDTree(cloud)
    _, near = tree.query(points, k=min(NEIGHBOURS, len(cloud)))
    offsets = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    return np.asarray(axes[:, :, 0])


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-30))
