"""Sweep back over a fitted take, so that every frame knows of those after it too.

The frames' means m and covariances P are those of a filter whose controls fade to rest by a factor
c a frame (:meth:`GaussianPrior.after`). With Q the spread before the next frame, going back

    G = c P Q^-1,    m' = m + G (m'_next - rest - c (m - rest)),    P' = P + G (P'_next - Q) G^T

(Rauch, Tung and Striebel 1965), m' within the face's bounds. P is made again from the poses, heads
and weights of the frames alone, so that a job that was resumed comes to the same; in blocks, as a
long take's do not fit into memory: forward for what each block begins with, then block by block
from the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt

import numpy as np
import scipy.linalg

from solver.fitting.face import Pose
from solver.fitting.known import KnownTerm
from solver.fitting.markers.filter import with_room
from solver.fitting.markers.observation import Markers
from solver.fitting.prior import GaussianPrior, kept_part
from solver.fitting.tracking import Tracker
from solver.similarity import Similarity
from solver.surface import Floats

SHORTEST_BLOCK = 240  # frames: takes of so many are gone over once


@dataclass(frozen=True)
class TracedFrame:
    """A fitted frame: its pose, head, and each marker's robust weight (k,).

    ``sigma`` (k, 3) are the take's own standard deviations, where it has them; ``known`` is the
    term of what a table knows of muscles.
    """

    pose: Pose
    head: Similarity
    weights: Floats
    sigma: Floats | None = None
    known: KnownTerm | None = None


@dataclass(frozen=True)
class SmoothFrame:
    """A frame after the sweep."""

    controls: Floats  # (q,)
    sd: Floats  # (q,)
    contraction_sd: Floats  # (m,) of the muscles' contractions, (0,) of fibre muscles


def smooth(
    markers: Markers, frames: Sequence[TracedFrame], shortest: int = SHORTEST_BLOCK
) -> list[SmoothFrame]:
    """Return the frames of a take after a sweep back, in blocks of ``shortest`` frames or more."""
    prior = markers.prior
    kept = kept_part(markers.seconds, markers.options.filter.forgetting)
    length = max(shortest, isqrt(len(frames)))
    blocks = [frames[first : first + length] for first in range(0, len(frames), length)]
    begins = [prior.covariance]
    covariances = []
    for block in blocks:
        covariances = _covariances(markers, block, begins[-1])
        begins.append(_spread(markers, covariances[-1]))
    found: list[SmoothFrame] = []
    mean = prior.mean
    after = prior.covariance
    table = None
    for number, block in reversed(list(enumerate(blocks))):
        if number < len(blocks) - 1:
            covariances = _covariances(markers, block, begins[number])
        for frame, here in zip(reversed(block), reversed(covariances), strict=True):
            own = frame.pose.vector()
            if found:
                spread = _spread(markers, here, table)
                gain = kept * scipy.linalg.solve(spread, here, assume_a="pos").T
                mean = own + gain @ (mean - prior.mean - kept * (own - prior.mean))
                mean = markers.face.layout.bounds.clip(mean)
                after = here + gain @ (after - spread) @ gain.T
            else:
                mean = own
                after = here
            table = frame.known
            sd = np.sqrt(np.maximum(np.diag(after), 0.0))
            found.append(SmoothFrame(mean, sd, markers.contraction_sd(after)))
    return found[::-1]


def _covariances(markers: Markers, frames: Sequence[TracedFrame], spread: Floats) -> list[Floats]:
    """Return what the filter knows after each of some frames, and ``spread`` before the first."""
    solver = Tracker(markers).solver
    found: list[Floats] = []
    for number, frame in enumerate(frames):
        before = _spread(markers, found[-1]) if found else spread
        normal = markers.normal(solver, frame.pose, frame.head, frame.weights, number, frame.sigma)
        prior = with_room(GaussianPrior(markers.prior.mean, before), frame.known)
        found.append(markers.filter.spread(prior, markers.filter.evidence(normal, frame.known)))
    return found


def _spread(markers: Markers, covariance: Floats, table: KnownTerm | None = None) -> Floats:
    """Return the covariance before a frame with a ``table``, after one with this covariance."""
    return markers.filter.later(markers.prior.mean, covariance, table).covariance
