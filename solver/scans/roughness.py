"""How rough a scan is: noise against a smooth surface, and spikes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from solver.surface import Floats, Ints

PROBES = 800
NEIGHBOURS = 24
RADIUS_MM = 3.0
SPIKE_EDGES, SPIKE_MM, SPIKE_ANGLE = 3.0, 6.0, np.radians(200.0)
UNKNOWNS = 6  # of a quadratic height field


@dataclass(frozen=True)
class Roughness:
    """``noise_mm`` of the face (median over places, NaN if too coarse to tell) and its spacing.

    ``spacing_mm`` is the median distance between neighbouring vertices.
    """

    noise_mm: float
    spacing_mm: float


def roughness(points: Floats, places: Floats, seed: int = 0) -> Roughness:
    """Return the roughness of the vertices (n, 3) of a scan at ``places`` (k, 3) of a face, in mm.

    At some of the places a quadratic height field is fitted to the neighbours within RADIUS_MM (in
    a coarse scan farther); what it leaves is noise, as skin is smooth at that size.
    """
    chosen = np.random.default_rng(seed).permutation(len(places))[:PROBES]
    tree = KDTree(points)
    centres = points[tree.query(places[chosen])[1]]
    distance, near = tree.query(centres, k=min(NEIGHBOURS, len(points)))
    spacing = float(np.median(distance[:, 1]))
    radius = max(RADIUS_MM, 2.5 * spacing)
    dense = (distance < radius).sum(axis=1) >= 2 * UNKNOWNS
    if dense.sum() < len(chosen) / 8:
        return Roughness(float("nan"), spacing)
    rms = [_misfit(points[near[k][distance[k] < radius]]) for k in np.flatnonzero(dense).tolist()]
    return Roughness(float(np.median(rms)), spacing)


def _misfit(points: Floats) -> float:
    """Return the standard deviation of points (n, 3) about a quadratic height field."""
    offsets = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    u, v, height = (offsets @ axes.T).T
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, height, rcond=None)[0]
    return float(np.sqrt(((height - fitted) ** 2).sum() / max(len(u) - UNKNOWNS, 1)))


def spikes(vertices: Floats, faces: Ints) -> NDArray[np.bool_]:
    """Return which vertices (n,) in mm stick out as spikes.

    A spike stands far from the middle of its neighbours, by SPIKE_MM and by SPIKE_EDGES times the
    scan's edges, and its triangles leave it within a narrow cone.
    """
    ends = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
    lengths = np.linalg.norm(ends, axis=2)
    unit = ends / (lengths[:, :, None] + 1e-30)
    cosine = -(unit * np.roll(unit, 1, axis=1)).sum(axis=2)
    corners, count = faces.ravel(), len(vertices)
    angle = np.bincount(corners, np.arccos(cosine.clip(-1, 1)).ravel(), minlength=count)
    degree = np.maximum(np.bincount(corners, minlength=count), 1)
    away = np.empty((count, 3))
    for axis in range(3):
        away[:, axis] = np.bincount(corners, ends[:, :, axis].ravel(), minlength=count) / degree
    height = np.linalg.norm(away, axis=1)
    limit = max(SPIKE_EDGES * float(np.median(lengths)), SPIKE_MM)
    return np.asarray((height > limit) & (angle < SPIKE_ANGLE) & (angle > 0))
