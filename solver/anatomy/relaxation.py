"""Moving a tetrahedral mesh to where skin and bones pull it, with tets of good shape.

One energy over all vertices x, the shape of every tet and springs to the guides:

    E(x) = sum_t c_t q_t(x)^4 + sum_i w_i |(R x)_i - g_i|^2

q is the mean-ratio distortion of a tet against the regular one, |F|^2 / (3 (det F)^(2/3)): one for
a regular tet of any size, infinite for a flat one. Below zero det F is replaced by the regularised
chi(det F) of Garanzha, Kaporin, Kudryavtseva, Protais, Ray and Sokolov (Foldover-free maps in 50
lines of code, ACM TOG 2021), which is finite and pushes inverted tets right. The fourth power is
for the worst tets: good ones are left to the springs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.sparse as sp
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.errors import SolveError
from solver.surface import Floats, Ints

POWER = 4.0  # of q in the energy: a kernel's constant
# Edges of the regular tet, in columns.
_REGULAR = np.array([[1.0, 0.5, 0.5], [0.0, 0.75**0.5, 0.75**0.5 / 3], [0.0, 0.0, (2 / 3) ** 0.5]])
_INVERSE = np.linalg.inv(_REGULAR)


@dataclass(frozen=True)
class RelaxationOptions:
    """Weights and rounds of the relaxation."""

    stiffness: float = 0.1  # c of a tet at first
    # Regularisation of chi, as a part of the volume of a tet of mean edge length, to untangle.
    untangling: float = 0.1
    smoothing: float = 0.01  # the same, for the result
    wanted_deg: float = 12.0  # tets with a smaller dihedral angle are stiffened and relaxed again
    stiffening: float = 3.0  # the factor of each such round
    rounds: int = 6
    iterations: int = 500  # of L-BFGS in the first round; later ones have a small way to go
    later_iterations: int = 120


RELAXATION = RelaxationOptions()


@dataclass(frozen=True)
class Guides:
    """Springs: ``rows`` (k, p) on the vertices, ``targets`` (k, 3) mm, ``weights`` (k,) 1/mm^2."""

    rows: sp.csr_array
    targets: Floats
    weights: Floats

    @classmethod
    def of_vertices(cls, ids: Ints, targets: Floats, weight: float, count: int) -> Guides:
        """Return springs of equal weight from the vertices ``ids`` (k,), of ``count`` in all."""
        rows = sp.csr_array(sp.eye_array(count, format="csr")[ids])
        return cls(rows, targets, np.full(len(ids), weight))

    @classmethod
    def join(cls, parts: list[Guides]) -> Guides:
        """Return the springs of all parts."""
        return cls(
            sp.csr_array(sp.vstack([part.rows for part in parts])),
            np.vstack([part.targets for part in parts]),
            np.concatenate([part.weights for part in parts]),
        )

    def energy(self, x: Floats) -> tuple[float, Floats]:
        """Return the springs' energy and its gradient (p, 3)."""
        away = self.rows @ x - self.targets
        pull = self.weights[:, None] * away
        return float(np.sum(pull * away)), 2.0 * (self.rows.T @ pull)


def relax(x: Floats, tets: Ints, guides: Guides) -> Floats:
    """Return the vertices (p, 3) of least energy, from the start ``x`` (p, 3) in mm.

    Raises :class:`SolveError` (``mesh.inverted``) if a tet stays inverted.
    """
    stiffness = np.full(len(tets), RELAXATION.stiffness)
    if volumes(x, tets).min() <= 0:
        x = _minimise(x, tets, guides, stiffness, RELAXATION.untangling, RELAXATION.iterations)
    x = _minimise(x, tets, guides, stiffness, RELAXATION.smoothing, RELAXATION.iterations)
    for _ in range(RELAXATION.rounds):
        bad = (dihedral_angles(x, tets).min(axis=1) < RELAXATION.wanted_deg) | (
            volumes(x, tets) <= 0
        )
        if not bad.any():
            break
        stiffness[bad] *= RELAXATION.stiffening
        x = _minimise(x, tets, guides, stiffness, RELAXATION.smoothing, RELAXATION.later_iterations)
    inverted = np.flatnonzero(volumes(x, tets) <= 0)
    if len(inverted):
        reason = f"{len(inverted)} tetrahedra stay inverted"
        raise SolveError("mesh.inverted", reason, tets=inverted[:10].tolist())
    return x


def _minimise(
    x: Floats, tets: Ints, guides: Guides, stiffness: Floats, smoothing: float, iterations: int
) -> Floats:
    unit = float(np.mean(np.abs(volumes(x, tets)))) ** (1 / 3)

    def energy(flat: Floats) -> tuple[float, Floats]:
        pose = flat.reshape(x.shape)
        gradient = np.zeros(x.shape)
        value = _shape_energy(pose / unit, tets, stiffness, smoothing, gradient)
        pull, force = guides.energy(pose)
        return value + pull, (gradient / unit + force).ravel()

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20, "ftol": 1e-9}
    # On several threads sums are added up in another order, and the last bits differ.
    with threadpool_limits(1):
        solution = minimize(energy, x.ravel(), jac=True, method="L-BFGS-B", options=options)
    return np.asarray(solution.x).reshape(x.shape)


@nb.njit(cache=True, error_model="numpy")
def _shape_energy(
    x: Floats, tets: Ints, stiffness: Floats, smoothing: float, gradient: Floats
) -> float:
    """Return sum c q^4 and add its derivative by ``x`` (p, 3) to ``gradient`` (p, 3)."""
    total = 0.0
    F = np.empty((3, 3))
    C = np.empty((3, 3))
    for t in range(len(tets)):
        tet = tets[t]
        for i in range(3):
            for j in range(3):
                F[i, j] = 0.0
                for k in range(3):
                    F[i, j] += (x[tet[k + 1], i] - x[tet[0], i]) * _INVERSE[k, j]
        square = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                C[i, j] = F[a, c] * F[b, d] - F[a, d] * F[b, c]
                square += F[i, j] * F[i, j]
        det = F[0, 0] * C[0, 0] + F[0, 1] * C[0, 1] + F[0, 2] * C[0, 2]
        root = math.sqrt(det * det + smoothing * smoothing)
        chi = 0.5 * (det + root)
        if chi <= 0.0:
            return math.inf
        power = chi ** (-2.0 / 3.0) / 3.0
        q = square * power
        total += stiffness[t] * q**POWER
        outer = stiffness[t] * POWER * q ** (POWER - 1.0)
        by_square = outer * 2.0 * power
        by_det = -outer * (2.0 / 3.0) * q / chi * 0.5 * (1.0 + det / root)
        for k in range(3):
            for i in range(3):
                slope = 0.0
                for j in range(3):
                    slope += (by_square * F[i, j] + by_det * C[i, j]) * _INVERSE[k, j]
                gradient[tet[k + 1], i] += slope
                gradient[tet[0], i] -= slope
    return total
