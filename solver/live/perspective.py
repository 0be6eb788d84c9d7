"""Take a near camera's perspective out of landmarks: what is nearer to it looks larger.

    u = c + s (1 + q z) y

is where a place y beside the middle of the face is seen, c that of the middle, s the size of a mm
there, z how far the place is in front of the middle and q one over the camera's distance. Of a
face half a metre away the nose is a tenth larger than the ears, which no motion of a far face
explains. How far the head is beside the picture's middle cannot be told from its turn, and is left
in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.similarity import fit_similarity
from solver.surface import Floats


@dataclass(frozen=True)
class PerspectiveOptions:
    """What is known of a camera before the first frame, and how long a frame counts."""

    sd: float = 1e-3  # of q, 1/mm: a far camera is the guess, one of a telephone no surprise
    most: float = 1 / 200.0  # 1/mm: nobody is filmed from nearer
    noise_mm: float = 2.0  # of a landmark beside where it is expected
    memory_s: float = 5.0  # after which a frame counts 1/e


class Perspective:
    """Finds q by all frames, the newest most, and takes it out of each."""

    def __init__(self, options: PerspectiveOptions = PerspectiveOptions()) -> None:
        self._options = options
        self.begin()

    def begin(self) -> None:
        """Forget what was before."""
        self._precision = self._options.sd**-2
        self._pull = 0.0

    @property
    def q(self) -> float:
        """One over the camera's distance, 1/mm."""
        return float(np.clip(self._pull / self._precision, 0.0, self._options.most))

    def flatten(self, seen: Floats, expected: Floats, seconds: float) -> Floats:
        """Return places ``seen`` (k, 3), z to the camera, in mm and as from far away.

        They are ``expected`` (k, 3) in the head's frame; of either some are NaN where nothing was
        seen. The frame comes ``seconds`` after the last.
        """
        known = np.isfinite(seen).all(axis=1)
        fit = fit_similarity(expected[known], seen[known])
        turned = (expected - expected[known].mean(axis=0)) @ fit.rotation.T
        middle = seen[known].mean(axis=0)
        self._learn(turned[known], (seen[known] - middle) / fit.scale, seconds)
        larger = 1.0 + self.q * turned[:, 2:]
        flat = np.column_stack([(seen - middle)[:, :2] / larger, (seen - middle)[:, 2]]) + middle
        size = fit_similarity(expected[known], flat[known]).scale
        return np.asarray(flat / max(size, 1e-9))

    def _learn(self, at: Floats, off: Floats, seconds: float) -> None:
        """Take what a frame says: places ``at`` (k, 3) were seen at ``off``, both in mm."""
        x, y, z = at.T
        one = np.ones_like(x)
        none = np.zeros_like(x)
        # size, turns about y, x and z, shift, and q
        along_x = np.array([x, z, none, -y, one, none, x * z])
        along_y = np.array([y, none, z, x, none, one, y * z])
        normal = along_x @ along_x.T + along_y @ along_y.T
        pull = along_x @ (off[:, 0] - x) + along_y @ (off[:, 1] - y)
        covariance = np.linalg.pinv(normal, hermitian=True)
        precision = 1.0 / max(covariance[-1, -1] * self._options.noise_mm**2, 1e-12)
        kept = np.exp(-seconds / self._options.memory_s)
        first = self._options.sd**-2
        self._precision = first + kept * (self._precision - first) + precision
        self._pull = kept * self._pull + precision * float(covariance[-1] @ pull)
