"""How much a registered vertex can be trusted, and how far the scan lies from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.normals import vertex_normals
from solver.registration.scan_surface import ScanSurface
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface
from solver.triangles import adjacency

COVERED_MM = 10.0
COVERED_COSINE = 0.5
TRUSTED_MM = 2.0
"""Distance at which confidence has fallen to 1/e."""


@dataclass(frozen=True)
class Trust:
    """Per skin vertex: ``confidence`` (n,) in [0, 1], ``covered`` (n,), ``distance_mm`` (n,).

    A vertex is covered where the scan has data: outer skin whose closest scan point is not on an
    edge of the scan, within 10 mm, and faces the same way. Elsewhere the confidence is 0 and the
    distance NaN.
    """

    confidence: Floats
    covered: NDArray[np.bool_]
    distance_mm: Floats


def trust(scan: ScanSurface, motion: Similarity, skin: Surface, outer: Ints) -> Trust:
    """Compare a registered ``skin`` with the scan that ``motion`` takes to it.

    Confidence is the product of a term of distance, one of the angle between the normals, and the
    share of neighbours that are covered, so that it fades towards holes.
    """
    count = len(skin.vertices)
    normals = vertex_normals(skin)[outer]
    found = scan.closest(motion.inverse()(skin.vertices[outer]))
    distance = found.distance * motion.scale
    cosine = np.einsum("nd,nd->n", normals, motion.turn(found.normals))
    seen = ~found.at_edge & (distance < COVERED_MM) & (cosine > COVERED_COSINE)
    covered = np.zeros(count, dtype=bool)
    covered[outer] = seen
    near = np.zeros(count)
    near[outer] = np.exp(-((distance / TRUSTED_MM) ** 2)) * np.clip(
        (cosine - COVERED_COSINE) / (0.9 - COVERED_COSINE), 0.0, 1.0
    )
    apart = np.full(count, np.nan)
    apart[outer[seen]] = distance[seen]
    confidence = np.where(covered, near * _share_of_neighbours(skin.faces, covered, outer), 0.0)
    return Trust(confidence, covered, apart)


def _share_of_neighbours(faces: Ints, covered: NDArray[np.bool_], outer: Ints) -> Floats:
    """Return the share (n,) of outer neighbours, within two edges, that are covered."""
    graph = adjacency(faces, len(covered))
    is_outer = np.zeros(len(covered))
    is_outer[outer] = 1.0
    have, all_ = covered.astype(float), is_outer
    for _ in range(2):
        have, all_ = graph @ have + have, graph @ all_ + all_
    return np.asarray(have / np.maximum(all_, 1e-12))
