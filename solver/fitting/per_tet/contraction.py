"""R_act: muscles prefer to contract along their fibres, each by one contraction gamma_m.

    R_act(a) = sum_im v_im |T(gamma_m, q_im) - S(a_i)|^2
    T(gamma, q) = 1/gamma q q^T + sqrt(gamma) (I - q q^T)

(Ichim et al. 2017, section 5.) From print: a muscle has one gamma_m, found by a 1-D root between
the solves for a; along the fibre q_im, the Laplace field's direction, T is 1/gamma, across it
sqrt(gamma), so its volume is kept and gamma > 1 is a contraction. Our reading: the weights v_im
(print: f_im) are parts of all muscle volume, not sums of tets; gamma is not bounded.
"""

from __future__ import annotations

import numpy as np

from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.stretches import FROBENIUS
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


class PreferredContraction:
    """R_act of one tissue; activations are (n_active, 6), contractions (m,)."""

    def __init__(self, tissue: Tissue) -> None:
        self._tissue = tissue
        self._row = np.repeat(np.arange(len(tissue.active)), np.diff(tissue.shares.indptr))
        x, y, z = tissue.fibres.T
        self._along = np.stack([x * x, x * y, x * z, y * y, y * z, z * z], axis=1)

    def contractions(self, a: Floats) -> Floats:
        """Return the gamma_m (m,) that minimise R_act at ``a``: the local step."""
        shares = self._tissue.shares
        along = np.sum(FROBENIUS * self._along * a[self._row], axis=1)
        across = (a @ IDENTITY)[self._row] - along
        m = shares.shape[1]
        sums = [np.bincount(shares.indices, shares.data * v, m) for v in (1.0, along, across)]
        volume = np.where(sums[0] > 0.0, sums[0], 1.0)
        return np.array(
            [
                contraction(float(p), float(q)) if v > 0.0 else 1.0
                for v, p, q in zip(sums[0], sums[1] / volume, sums[2] / volume, strict=True)
            ]
        )

    def value(self, a: Floats, gamma: Floats) -> float:
        """Return R_act(a)."""
        offset = a[self._row] - self._preferred(gamma)
        return float(self._tissue.shares.data @ (offset**2 @ FROBENIUS))

    def gradient(self, a: Floats, gamma: Floats) -> Floats:
        """Return its derivative by a, (n_active, 6): by gamma it is zero at its minimum."""
        offset = self._tissue.shares.data[:, None] * (a[self._row] - self._preferred(gamma))
        sums = np.add.reduceat(offset, self._tissue.shares.indptr[:-1])
        return np.asarray(2.0 * FROBENIUS * sums)

    def curvature(self) -> Floats:
        """Return the diagonal (n_active, 6) of its Hessian by a, the gamma_m being held."""
        return np.asarray(2.0 * self._tissue.volumes[:, None] * FROBENIUS)

    def _preferred(self, gamma: Floats) -> Floats:
        """Return T(gamma_m, q_im) as (nnz, 6)."""
        root = np.sqrt(gamma)
        muscle = self._tissue.shares.indices
        along = (1.0 / gamma - root)[muscle, None] * self._along
        return np.asarray(along + root[muscle, None] * IDENTITY)


def contraction(along: float, across: float) -> float:
    """Return the gamma that minimises the mean of |T(gamma, q) - S(a)|^2 over a muscle.

    ``along`` is the mean of q . S(a) q, ``across`` of tr S(a) less that: 1 and 2 at rest. Up to a
    constant the mean is 1/gamma^2 - 2 along/gamma + 2 gamma - 2 across sqrt(gamma), stationary
    where 2 u^6 - across u^5 + 2 along u^2 - 2 = 0 for u = sqrt(gamma). There is always a positive
    root; of several the lowest counts.
    """
    roots = np.roots([2.0, -across, 0.0, 0.0, 2.0 * along, 0.0, -2.0])
    gammas = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)] ** 2
    if not len(gammas):  # a double root, rounded into the complex plane
        gammas = roots.real[[np.argmin(np.abs(roots.imag) + 1e9 * (roots.real <= 0.0))]] ** 2
    values = 1.0 / gammas**2 - 2.0 * along / gammas + 2.0 * gammas - 2.0 * across * np.sqrt(gammas)
    return float(gammas[np.argmin(values)])
