"""R_sparse: few muscles are active at a time.

    R_sparse(a) = sum_m sqrt(sum_i v_im |a_i - a_I|^2 + delta^2) - delta

(Ichim et al. 2017, section 5: print has |a_i|, which only makes sense as the distance from passive
flesh.) A group lasso, minimised by iterative reweighting: at every iterate each root is replaced by
the parabola that touches it there and lies above it elsewhere.
"""

from __future__ import annotations

import numpy as np

from solver.fitting.per_tet.tissue import Tissue
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats

SMOOTHING = 1e-3
"""delta: a whole face with activations of this size counts as passive."""


class GroupSparsity:
    """R_sparse of one tissue; activations are (n_active, 6)."""

    def __init__(self, tissue: Tissue) -> None:
        self._shares = tissue.shares

    def value(self, a: Floats) -> float:
        """Return R_sparse(a)."""
        return float(np.sum(self._norms(a) - SMOOTHING))

    def gradient(self, a: Floats) -> Floats:
        """Return its derivative by a, (n_active, 6)."""
        return np.asarray(self.curvature(a) * (a - IDENTITY))

    def curvature(self, a: Floats) -> Floats:
        """Return the parabolas' second derivative by each entry of a, (n_active, 1)."""
        return np.asarray(self._shares @ (1.0 / self._norms(a)))[:, None]

    def _norms(self, a: Floats) -> Floats:
        squares = np.sum((a - IDENTITY) ** 2, axis=1)
        return np.asarray(np.sqrt(self._shares.T @ squares + SMOOTHING**2))
