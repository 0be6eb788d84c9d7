"""Sweep back over a fitted take, so that every frame knows of those after it too.

The frames' means m and covariances P are those of a filter whose controls fade to rest by a factor
c a frame (:meth:`GaussianPrior.after`). With Q the spread before the next frame, going back

    G = c P Q^-1,    m' = m + G (m'_next - rest - c (m - rest)),    P' = P + G (P'_next - Q) G^T

(Rauch, Tung and Striebel 1965). P is made again from the poses, heads and weights of the frames
alone, so that a job that was resumed comes to the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import scipy.linalg

from solver.fitting.face import Pose
from solver.fitting.information import inverse_of_positive
from solver.fitting.markers.tracker import MarkerTracker
from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class TracedFrame:
    """What a fitted frame tells: its pose, head, and the say (k,) that each marker had."""

    pose: Pose
    head: Similarity
    weights: Floats


@dataclass(frozen=True)
class SmoothFrame:
    """A frame after the sweep."""

    controls: Floats  # (q,)
    sd: Floats  # (q,)


def smooth(
    tracker: MarkerTracker, frames: Sequence[TracedFrame], folder: Path | None = None
) -> list[SmoothFrame]:
    """Return the frames of a take after a sweep back; ``folder`` is where covariances wait."""
    prior, size = tracker.prior, tracker.face.layout.size
    tracker.begin(tracker.face.rest, None)
    kept = np.exp(-tracker.seconds / tracker.options.forgetting)
    found: list[SmoothFrame] = []
    with TemporaryFile(dir=folder) as file:
        stored = np.memmap(file, np.float32, "w+", shape=(len(frames), size, size))
        spread = prior.covariance
        for number, frame in enumerate(frames):
            normal = tracker.normal(frame.pose, frame.head, frame.weights, number)
            covariance = inverse_of_positive(inverse_of_positive(spread) + normal)
            stored[number] = covariance
            spread = kept**2 * covariance + (1.0 - kept**2) * prior.covariance
        mean, after = frames[-1].pose.vector(), np.asarray(stored[-1], np.float64)
        found.append(SmoothFrame(mean, np.sqrt(np.diag(after))))
        for number in range(len(frames) - 2, -1, -1):
            own, here = frames[number].pose.vector(), np.asarray(stored[number], np.float64)
            spread = kept**2 * here + (1.0 - kept**2) * prior.covariance
            gain = kept * scipy.linalg.solve(spread, here, assume_a="pos").T
            mean = own + gain @ (mean - prior.mean - kept * (own - prior.mean))
            after = here + gain @ (after - spread) @ gain.T
            found.append(SmoothFrame(mean, np.sqrt(np.maximum(np.diag(after), 0.0))))
    return found[::-1]
