"""Confidence in registered vertices, and their distances to the scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.registration.scan_surface import ScanSurface
from solver.similarity import IDENTITY, Similarity, weighted_motion
from solver.surface import Floats, Ints, Surface, adjacency, vertex_normals


@dataclass(frozen=True)
class ConfidenceOptions:
    """Limits of what a scan says of a registered vertex."""

    covered_mm: float = 10.0  # farther there is no data
    covered_cosine: float = 0.5  # of the normals, at least
    trusted_mm: float = 2.0  # distance at which confidence has fallen to 1/e


TRUST = ConfidenceOptions()


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
    seen = ~found.at_edge & (distance < TRUST.covered_mm) & (cosine > TRUST.covered_cosine)
    covered = np.zeros(count, dtype=bool)
    covered[outer] = seen
    near = np.zeros(count)
    near[outer] = np.exp(-((distance / TRUST.trusted_mm) ** 2)) * np.clip(
        (cosine - TRUST.covered_cosine) / (0.9 - TRUST.covered_cosine), 0.0, 1.0
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


# Head motion out of an expression: what lies still on the skull stays where the neutral has it.
#
# Rigid stabilisation after Beeler & Bradley, "Rigid stabilization of facial expressions" (SIGGRAPH
# 2014), with the expression's fitted shapes, instead of a skull, telling skin motion from head
# motion.


STEPS = 6  # of reweighting
SLACK_MM = 0.5  # a vertex that moves by more on its own loses its say


def head_motion(registered: Floats, expected: Floats, weights: Floats) -> Similarity:
    """Return the rigid motion that takes ``registered`` (n, 3) back onto ``expected`` (n, 3).

    ``weights`` (n,) say how still and how well seen each vertex is; vertices that move on their
    own by more than about :data:`SLACK_MM` lose their say.
    """
    used = np.flatnonzero(weights > 1e-3)
    if len(used) < 10:
        return IDENTITY
    motion = IDENTITY
    for _ in range(STEPS):
        away = np.linalg.norm(motion(registered[used]) - expected[used], axis=1)
        robust = weights[used] / (1 + (away / SLACK_MM) ** 2) ** 2
        motion = weighted_motion(registered[used], expected[used], robust)
    return motion
