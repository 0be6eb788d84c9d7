"""Pairs of model points and scan points, with the weight each pair deserves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.registration.scan_surface import ScanSurface
from solver.similarity import Similarity
from solver.surface import Floats, Ints

MIN_COSINE = 0.5
"""Normals further apart than 60 degrees are not of the same place."""


@dataclass(frozen=True)
class Pairs:
    """What the scan says about each model point, in the template's frame.

    ``points`` and ``normals`` (n, 3) of the scan; ``offset`` (n,) how far the scan lies along its
    normal, in mm; ``weights`` (n,) in [0, 1], zero where there is nothing to follow.
    """

    points: Floats
    normals: Floats
    offset: Floats
    weights: Floats


@dataclass(frozen=True)
class Pins:
    """Landmarks: ``points`` (k, 3) of the scan and the ``vertices`` (k,) they mark."""

    points: Floats
    vertices: Ints


def pair(
    scan: ScanSurface,
    motion: Similarity,
    points: Floats,
    normals: Floats,
    reach: float,
    *,
    alike: bool = False,
) -> Pairs:
    """Return the closest points of a moved scan to model ``points`` (n, 3).

    ``reach`` (mm) is the distance at which a pair's weight is a quarter (Geman & McClure 1987) and
    a third of the one at which it is none; neither edges of the scan nor surfaces that face
    elsewhere count. With ``alike``, points that face the same way come before closer ones.
    """
    back = motion.inverse()
    found = scan.alike(back(points), back.turn(normals)) if alike else scan.closest(back(points))
    targets, directions = motion(found.points), motion.turn(found.normals)
    distance = found.distance * motion.scale
    cosine = np.einsum("nd,nd->n", normals, directions)
    weights = 1 / (1 + (distance / reach) ** 2) ** 2
    weights *= np.clip((cosine - MIN_COSINE) / (0.9 - MIN_COSINE), 0.0, 1.0)
    weights[found.at_edge | (distance > 3 * reach)] = 0.0
    offset = np.einsum("nd,nd->n", targets - points, directions)
    return Pairs(targets, directions, offset, weights)


def pinned(pairs: Pairs, points: Floats, targets: Floats, weight: float) -> Pairs:
    """Add landmarks: model ``points`` (k, 3) held at ``targets`` (k, 3) along all three axes."""
    axes = np.tile(np.eye(3), (len(points), 1))
    places, goals = np.repeat(points, 3, axis=0), np.repeat(targets, 3, axis=0)
    return Pairs(
        np.concatenate([pairs.points, goals]),
        np.concatenate([pairs.normals, axes]),
        np.concatenate([pairs.offset, np.einsum("nd,nd->n", goals - places, axes)]),
        np.concatenate([pairs.weights, np.full(len(axes), weight)]),
    )


def motion_columns(pairs: Pairs, *, sizes: bool) -> Floats:
    """Return the change (n, 6 or 7) of ``offset`` by the scan's rotation, shift and growth."""
    columns = [np.cross(pairs.points, pairs.normals), pairs.normals]
    if sizes:
        columns.append(np.einsum("nd,nd->n", pairs.points, pairs.normals)[:, None])
    return np.hstack(columns)
