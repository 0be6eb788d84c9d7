"""Initial S: which part of a tetrahedron each muscle fills, and which muscles may come near it."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import volumes
from solver.surface import Floats, Ints, Surface
from solver.triangles import directed_edges

CANDIDATE_MM = 10.0
"""A muscle may act in the tetrahedra within this distance (the paper's sparsity of S)."""
NEAR_LEVEL, LEVEL, FINE_LEVEL = 1, 2, 3
"""Tetrahedra are sampled at the centres of 8^level parts."""
FINE_BELOW_MM3 = 600.0
"""Smaller muscles, which are thin, are sampled finely."""
VOLUME_SAMPLES = 40_000
_OCTASECTION = (
    ((0, 0), (0, 1), (0, 2), (0, 3)),
    ((1, 1), (0, 1), (1, 2), (1, 3)),
    ((2, 2), (0, 2), (1, 2), (2, 3)),
    ((3, 3), (0, 3), (1, 3), (2, 3)),
    ((0, 2), (1, 3), (0, 1), (0, 3)),
    ((0, 2), (1, 3), (0, 3), (2, 3)),
    ((0, 2), (1, 3), (2, 3), (1, 2)),
    ((0, 2), (1, 3), (1, 2), (0, 1)),
)
"""Eight equal parts of a tetrahedron: each corner is half way between two of its corners."""


def initial_weights(vertices: Floats, tets: Ints, muscles: list[Surface]) -> sp.csr_array:
    """Return S (t, m + 1): volume fractions of muscles in tetrahedra, column 0 the passive rest.

    Stored entries are the candidates: the passive column and every muscle within
    :data:`CANDIDATE_MM` of a tetrahedron, explicit zeros included. Rows sum to one.
    """
    row_parts, column_parts, fraction_parts = [], [], []
    for column, muscle in enumerate(muscles, start=1):
        candidates = _candidates(vertices, tets, muscle)
        row_parts.append(candidates)
        column_parts.append(np.full(len(candidates), column))
        fraction_parts.append(_fractions(vertices[tets[candidates]], muscle))
    rows, columns = np.concatenate(row_parts), np.concatenate(column_parts)
    sizes = np.array([enclosed_volume(muscle) for muscle in muscles])
    fractions = _without_overlap(rows, np.concatenate(fraction_parts), sizes[columns - 1])
    passive = 1.0 - np.minimum(np.bincount(rows, fractions, minlength=len(tets)), 1.0)
    every = np.arange(len(tets))
    rows = np.concatenate([every, rows])
    columns = np.concatenate([np.zeros(len(tets), dtype=np.int64), columns])
    values = np.concatenate([passive, fractions])
    order = np.lexsort((columns, rows))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(tets)))])
    return sp.csr_array(
        (values[order], columns[order], indptr), shape=(len(tets), len(muscles) + 1)
    )


def _without_overlap(rows: Ints, fractions: Floats, sizes: Floats) -> Floats:
    """Return the fractions (k,) with no tet, of number ``rows`` (k,), filled more than wholly.

    Muscles overlap where they interlace. What is too much is taken from each by its fraction times
    its size in mm^3, ``sizes`` (k,): large muscles hardly miss what would be half of a small one.
    """
    excess = np.maximum(np.bincount(rows, fractions) - 1.0, 0.0)
    yielding = fractions * sizes
    total = np.maximum(np.bincount(rows, yielding), 1e-12)
    left = np.maximum(fractions - (excess / total)[rows] * yielding, 0.0)
    return np.asarray(left / np.maximum(np.bincount(rows, left), 1.0)[rows])


def muscle_volumes(vertices: Floats, tets: Ints, weights: sp.csr_array) -> Floats:
    """Return the volumes (m,) in mm^3 that the muscles have in the tetrahedra."""
    return np.asarray(weights.T @ volumes(vertices, tets))[1:]


def enclosed_volume(surface: Surface) -> float:
    """Return the volume in mm^3 of the points that a surface winds around.

    Where it is closed that is a sum over its triangles. Else, with gaps or pieces inside out, it is
    counted on a grid along the surface's principal axes, to about 2 %.
    """
    middle = surface.vertices.mean(axis=0)
    if _closed(surface.faces):
        corners = surface.vertices[surface.faces] - middle
        return float(abs(np.linalg.det(corners).sum()) / 6.0)
    axes = np.linalg.svd(surface.vertices - middle, full_matrices=False)[2]
    local = (surface.vertices - middle) @ axes.T
    lo, hi = local.min(axis=0), local.max(axis=0)
    box = float(np.prod(hi - lo))
    counts = np.ceil((hi - lo) / (box / VOLUME_SAMPLES) ** (1 / 3)).astype(int)
    steps = [lo[k] + (hi - lo)[k] * (np.arange(n) + 0.5) / n for k, n in enumerate(counts)]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return box * float(contains(surface, grid @ axes + middle).mean())


def _closed(faces: Ints) -> bool:
    """Return whether every edge has two faces, which run along it in opposite directions."""
    edges = directed_edges(faces)
    places = np.array([faces.max() + 1, 1])
    there, back = np.sort(edges @ places), np.sort(edges[:, ::-1] @ places)
    return bool(np.array_equal(there, back) and (np.diff(there) > 0).all())


def contains(surface: Surface, points: Floats) -> np.ndarray:
    """Return (n,) True where a point lies inside; the surface may have gaps or be inside out."""
    winding = np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, points))
    return np.asarray(np.abs(winding) > 0.5)


def _fractions(corners: Floats, muscle: Surface) -> Floats:
    """Return which part (t,) of tetrahedra with ``corners`` (t, 4, 3) a muscle fills."""
    centres = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    touched = np.flatnonzero(_within(centres, muscle, reach))
    samples = _samples(FINE_LEVEL if enclosed_volume(muscle) < FINE_BELOW_MM3 else LEVEL)
    points = np.einsum("sk,tkd->tsd", samples, corners[touched])
    inside = contains(muscle, points.reshape(-1, 3)).reshape(len(touched), len(samples))
    fractions = np.zeros(len(corners))
    fractions[touched] = inside.mean(axis=1)
    return fractions


def _samples(level: int) -> Floats:
    """Return (8^level, 4) barycentric coordinates of the centres of equal parts."""
    parts = np.eye(4)[None]
    for _ in range(level):
        pairs = parts[:, np.array(_OCTASECTION)]
        parts = pairs.mean(axis=3).reshape(-1, 4, 4)
    return np.asarray(parts.mean(axis=1))


def _candidates(vertices: Floats, tets: Ints, surface: Surface) -> Ints:
    """Return the tetrahedra within :data:`CANDIDATE_MM` of a muscle, by corners and samples."""
    near = np.asarray(_within(vertices, surface, CANDIDATE_MM)[tets].any(axis=1))
    others = np.flatnonzero(~near)
    corners = vertices[tets[others]]
    centres = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    possible = _within(centres, surface, CANDIDATE_MM + reach)
    points = np.einsum("sk,tkd->tsd", _samples(NEAR_LEVEL), corners[possible])
    inside = _within(points.reshape(-1, 3), surface, CANDIDATE_MM)
    near[others[possible]] = inside.reshape(points.shape[:2]).any(axis=1)
    return np.flatnonzero(near)


def _within(points: Floats, surface: Surface, reach: Floats | float) -> np.ndarray:
    """Return (n,) True where a point lies inside a surface or within ``reach`` of it."""
    lo, hi = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    reach = np.broadcast_to(reach, len(points))
    gap = np.maximum(lo - points, points - hi).max(axis=1)
    near = np.flatnonzero(gap <= reach)
    result = np.zeros(len(points), dtype=bool)
    if len(near) == 0:
        return result
    squared = igl.point_mesh_squared_distance(points[near], surface.vertices, surface.faces)[0]
    distance = np.sqrt(squared)
    result[near] = distance <= reach[near]
    # What lies deeper inside is at least as far from the sides of the bounding box.
    deep = near[~result[near] & (-gap[near] >= distance)]
    if len(deep):
        result[deep] = contains(surface, points[deep])
    return result
