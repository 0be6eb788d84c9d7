"""Mend a reduced skin by full solves: what it was off at them, interpolated by a kernel.

    q(z) = q_0(z) + sum_i k(z, z_i) w_i,    k(z, y) = s z . y + exp(-|z - y|^2 / 2 l^2)

with z the slider values and clues of a frame, each by its scale; q_0 are the amounts of the modes
as the reduced skin has them and w solve (K + n I) w = q - q_0 over the frames that were solved: the
mean of a Gaussian process (Rasmussen and Williams 2006, chapter 2). The modes stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from solver.live.samples import SolvedFrames
from solver.surface import Floats


@dataclass(frozen=True)
class MendOptions:
    """The kernel of a mended skin, and how much is remembered."""

    most: int = 400  # frames
    value: float = 0.4  # scale of a slider's value
    clue_mm: float = 3.0  # scale of a clue
    length: float = 3.0  # l, in these
    linear: float = 0.1  # s
    noise: float = 0.005  # n


@dataclass(frozen=True, eq=False)
class Mend:
    """What is added to amounts: ``pulls`` (n, r) at the features ``at`` (n, d)."""

    at: NDArray[np.float32]
    pulls: NDArray[np.float32]
    options: MendOptions

    @classmethod
    def nothing(cls, features: int, amounts: int) -> Mend:
        """Return the mend of no full solve."""
        none = np.zeros((0, features), np.float32)
        return cls(none, np.zeros((0, amounts), np.float32), MendOptions())

    def __call__(self, values: Floats, clues: Floats) -> Floats:
        """Return what is added to the amounts (r,) of a frame."""
        z = _features(values, clues, self.options).astype(np.float32)
        apart = ((self.at - z) ** 2).sum(axis=1)
        return np.asarray(_kernel(self.at @ z, apart, self.options) @ self.pulls, np.float64)


class Mender:
    """Collects frames that were solved, and makes mends of them."""

    def __init__(self, options: MendOptions = MendOptions()) -> None:
        self._options = options
        self._at: list[Floats] = []
        self._off: list[Floats] = []

    def add(self, values: Floats, clues: Floats, off: Floats) -> None:
        """Take a frame whose amounts are ``off`` (r,) those of the reduced skin.

        Where there is no more room the older of the two that are most alike is forgotten.
        """
        self._at.append(_features(values, clues, self._options))
        self._off.append(off)
        if len(self._at) > self._options.most:
            apart = cdist(self._at, self._at)
            apart[np.diag_indices_from(apart)] = np.inf
            oldest = int(min(np.unravel_index(np.argmin(apart), apart.shape)))
            del self._at[oldest], self._off[oldest]

    @property
    def frames(self) -> SolvedFrames | None:
        """The frames, for a session that goes on for this one; None without any."""
        return SolvedFrames(np.array(self._at), np.array(self._off)) if self._at else None

    def begin(self, frames: SolvedFrames) -> None:
        """Go on with frames that another session has solved."""
        self._at = [*frames.at]
        self._off = [*frames.off]

    def mend(self) -> Mend | None:
        """Return the mend of all frames; None without any."""
        if not self._at:
            return None
        at = np.array(self._at)
        options = self._options
        matrix = _kernel(at @ at.T, cdist(at, at, "sqeuclidean"), options)
        matrix[np.diag_indices_from(matrix)] += options.noise
        pulls = scipy.linalg.solve(matrix, np.array(self._off), assume_a="pos")
        return Mend(at.astype(np.float32), pulls.astype(np.float32), options)


def _features(values: Floats, clues: Floats, options: MendOptions) -> Floats:
    return np.concatenate([values / options.value, clues / options.clue_mm])


def _kernel(
    inner: NDArray[np.floating], apart: NDArray[np.floating], options: MendOptions
) -> NDArray[np.floating]:
    """Return k by inner products and squared distances."""
    return np.asarray(options.linear * inner + np.exp(apart / (-2.0 * options.length**2)))
