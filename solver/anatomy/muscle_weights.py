"""Initial S: which part of a tetrahedron each muscle fills, and which muscles may come near it."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import volumes
from solver.surface import Floats, Ints, Surface

CANDIDATE_MM = 10.0
"""A muscle may act in the tetrahedra within this distance (the paper's sparsity of S)."""
NEAR_SAMPLES = 8
SAMPLES = 24
SMALL_SAMPLES = 160
SMALL_VOLUME_MM3 = 1500.0


def initial_weights(vertices: Floats, tets: Ints, muscles: list[Surface]) -> sp.csr_array:
    """Return S (t, m + 1): volume fractions of muscles in tetrahedra, column 0 the passive rest.

    Stored entries are the candidates: the passive column and every muscle within
    :data:`CANDIDATE_MM` of a tetrahedron, explicit zeros included. Rows sum to one.
    """
    near = _corners_and_inside(vertices, tets)
    few, many = _barycentric(SAMPLES), _barycentric(SMALL_SAMPLES)
    row_parts, column_parts, fraction_parts = [], [], []
    for column, muscle in enumerate(muscles, start=1):
        candidates = np.flatnonzero(_distance(near, muscle) <= CANDIDATE_MM)
        samples = many if enclosed_volume(muscle) < SMALL_VOLUME_MM3 else few
        points = np.einsum("sk,tkd->tsd", samples, vertices[tets[candidates]])
        inside = contains(muscle, points.reshape(-1, 3)).reshape(len(candidates), -1)
        row_parts.append(candidates)
        column_parts.append(np.full(len(candidates), column))
        fraction_parts.append(inside.mean(axis=1))
    rows, columns = np.concatenate(row_parts), np.concatenate(column_parts)
    fractions = np.concatenate(fraction_parts)
    total = np.bincount(rows, fractions, minlength=len(tets))
    # Muscles overlap where they interlace, so that shares may exceed the whole.
    fractions /= np.maximum(total, 1.0)[rows]
    passive = 1.0 - np.minimum(total, 1.0)
    every = np.arange(len(tets))
    rows = np.concatenate([every, rows])
    columns = np.concatenate([np.zeros(len(tets), dtype=np.int64), columns])
    values = np.concatenate([passive, fractions])
    order = np.lexsort((columns, rows))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(tets)))])
    return sp.csr_array(
        (values[order], columns[order], indptr), shape=(len(tets), len(muscles) + 1)
    )


def muscle_volumes(vertices: Floats, tets: Ints, weights: sp.csr_array) -> Floats:
    """Return the volumes (m,) in mm^3 that the muscles have in the tetrahedra."""
    return np.asarray(weights.T @ volumes(vertices, tets))[1:]


def enclosed_volume(surface: Surface) -> float:
    """Return the volume in mm^3 that a (nearly) closed surface encloses."""
    corners = surface.vertices[surface.faces] - surface.vertices.mean(axis=0)
    return float(abs(np.linalg.det(corners).sum()) / 6.0)


def contains(surface: Surface, points: Floats) -> np.ndarray:
    """Return (n,) True where a point lies inside; the surface may have gaps or be inside out."""
    winding = np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, points))
    return np.asarray(np.abs(winding) > 0.5)


def _corners_and_inside(vertices: Floats, tets: Ints) -> Floats:
    """Return (t, 4 + NEAR_SAMPLES, 3) points of every tetrahedron."""
    weights = np.vstack([np.eye(4), _barycentric(NEAR_SAMPLES)])
    return np.asarray(np.einsum("sk,tkd->tsd", weights, vertices[tets]))


def _barycentric(count: int) -> Floats:
    return np.random.default_rng(0).dirichlet(np.ones(4), count)


def _distance(points: Floats, surface: Surface) -> Floats:
    """Return (t,) the least distance of each row of points (t, k, 3) to a muscle."""
    lo, hi = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    outside = np.maximum(np.maximum(lo - points, points - hi), 0.0)
    box = np.linalg.norm(outside, axis=2).min(axis=1)
    near = np.flatnonzero(box <= CANDIDATE_MM)
    distance = np.full(len(points), np.inf)
    if len(near) == 0:
        return distance
    flat = points[near].reshape(-1, 3)
    squared = igl.point_mesh_squared_distance(flat, surface.vertices, surface.faces)[0]
    squared = np.where(contains(surface, flat), 0.0, squared)
    distance[near] = np.sqrt(squared.reshape(len(near), -1).min(axis=1))
    return distance
