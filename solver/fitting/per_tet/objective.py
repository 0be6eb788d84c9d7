"""f of the per-tet model: its regularisers, and its Gauss-Newton model at an equilibrium."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting import stretches
from solver.fitting.controls import JAW_UNITS
from solver.fitting.face import Pose, PosedFace
from solver.fitting.objective import Term
from solver.fitting.per_tet.saddle import Quadratic
from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.stretches import FROBENIUS, determinant_gradients, determinants
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


class PreferredContraction:
    """R_act: muscles prefer to contract along their fibres, each by one contraction gamma_m.

        R_act(a) = sum_im v_im |T(gamma_m, q_im) - S(a_i)|^2
        T(gamma, q) = 1/gamma q q^T + sqrt(gamma) (I - q q^T)

    (Ichim et al. 2017, section 5.) From print: a muscle has one gamma_m, found by a 1-D root
    between the solves for a; T keeps the volume and gamma > 1 is a contraction along the fibre
    q_im, the Laplace field's direction. Our reading: the weights v_im (print: f_im) are parts of
    all muscle volume, not sums of tets; gamma is not bounded. Activations are (n_active, 6),
    contractions (m,).
    """

    def __init__(self, tissue: Tissue) -> None:
        self._tissue = tissue
        self._row = np.repeat(np.arange(len(tissue.active)), np.diff(tissue.fractions.indptr))
        self._along = stretches.entries(tissue.fibres)

    def contractions(self, a: Floats) -> Floats:
        """Return the gamma_m (m,) that minimise R_act at ``a``: the local step."""
        fractions = self._tissue.fractions
        along = np.sum(FROBENIUS * self._along * a[self._row], axis=1)
        across = (a @ IDENTITY)[self._row] - along
        m = fractions.shape[1]
        sums = [np.bincount(fractions.indices, fractions.data * v, m) for v in (1.0, along, across)]
        gamma = np.ones(m)
        for muscle in np.flatnonzero(sums[0] > 0.0):
            volume, *means = (each[muscle] for each in sums)
            gamma[muscle] = contraction(*(float(mean / volume) for mean in means))
        return gamma

    def value(self, a: Floats, gamma: Floats) -> float:
        """Return R_act(a)."""
        offset = a[self._row] - self._target(gamma)
        return float(self._tissue.fractions.data @ (offset**2 @ FROBENIUS))

    def gradient(self, a: Floats, gamma: Floats) -> Floats:
        """Return its derivative by a, (n_active, 6): by gamma it is zero at its minimum."""
        offset = self._tissue.fractions.data[:, None] * (a[self._row] - self._target(gamma))
        sums = np.add.reduceat(offset, self._tissue.fractions.indptr[:-1])
        return np.asarray(2.0 * FROBENIUS * sums)

    def curvature(self) -> Floats:
        """Return the diagonal (n_active, 6) of its Hessian by a, the gamma_m being held."""
        return np.asarray(2.0 * self._tissue.volumes[:, None] * FROBENIUS)

    def _target(self, gamma: Floats) -> Floats:
        """Return T(gamma_m, q_im) as (nnz, 6)."""
        root = np.sqrt(gamma)
        muscle = self._tissue.fractions.indices
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


@dataclass(frozen=True)
class PerTetOptions:
    """Weights of the regularisers, and when to stop."""

    w_act: float = 0.01  # mm^2
    w_sparse: float = 1e-3  # mm^2
    w_volume: float = 10.0  # mm^2
    w_b: float = 1e-6  # of the jaw's change
    max_iterations: int = 60
    tolerance: float = 2e-3  # gain of a step, relative to f, that ends the fit
    smoothing: float = 1e-3  # delta: a whole face with activations of this size counts as passive


PER_TET = PerTetOptions()


class PerTetPriors:
    """f but for the data: the regularisers of a ``tissue``, the jaw's around ``b`` (5,).

    R_sparse: few muscles are active at a time.

        R_sparse(a) = sum_m sqrt(sum_i v_im |a_i - a_I|^2 + delta^2) - delta

    (Ichim et al. 2017, section 5: print has |a_i|, which only makes sense as the distance from
    passive flesh.) A group lasso, minimised by iterative reweighting: at every iterate each root is
    replaced by the parabola that touches it there and lies above it elsewhere.
    """

    def __init__(self, tissue: Tissue, options: PerTetOptions, b: Floats) -> None:
        self._options = options
        self._b = b
        self._fractions = tissue.fractions
        self._volumes = tissue.volumes
        self.contraction = PreferredContraction(tissue)

    def value(self, pose: Pose) -> float:
        """Return the regularisers' sum at a pose, every gamma being the best."""
        options = self._options
        a = pose.a
        jaw = JAW_UNITS * (pose.b - self._b)
        return float(
            options.w_act * self.contraction.value(a, self.contraction.contractions(a))
            + options.w_sparse * float(np.sum(self._norms(a) - options.smoothing))
            + options.w_volume * (self._volumes @ (determinants(a) - 1.0) ** 2)
            + 0.5 * options.w_b * jaw @ jaw
        )

    def gradient(self, pose: Pose) -> Floats:
        """Return the derivative of :meth:`value` by (a, b)."""
        options = self._options
        a = pose.a
        stretch = 2.0 * options.w_volume * self._volumes * (determinants(a) - 1.0)
        by_a = options.w_act * self.contraction.gradient(a, self.contraction.contractions(a))
        by_a += options.w_sparse * (self._parabolas(a) * (a - IDENTITY))
        by_a += stretch[:, None] * determinant_gradients(a)
        return pose.layout.join([by_a, options.w_b * JAW_UNITS**2 * (pose.b - self._b)])

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return the Gauss-Newton Hessian: a block of each tet, (n_active, 6, 6), and b's diagonal.

        The contractions are held, and the parabolas of R_sparse stand for it.
        """
        options = self._options
        slopes = determinant_gradients(pose.a)
        volume = 2.0 * options.w_volume * self._volumes
        blocks = volume[:, None, None] * slopes[:, :, None] * slopes[:, None, :]
        each = np.arange(6)
        blocks[:, each, each] += options.w_act * self.contraction.curvature()
        blocks[:, each, each] += options.w_sparse * self._parabolas(pose.a)
        return blocks, options.w_b * JAW_UNITS**2

    def _parabolas(self, a: Floats) -> Floats:
        """Return the parabolas' second derivative by each entry of a, (n_active, 1)."""
        return np.asarray(self._fractions @ (1.0 / self._norms(a)))[:, None]

    def _norms(self, a: Floats) -> Floats:
        squares = np.sum((a - IDENTITY) ** 2, axis=1)
        return np.asarray(np.sqrt(self._fractions.T @ squares + self._options.smoothing**2))


class Objective:
    """f as a function of a tissue's state, with its derivatives."""

    def __init__(self, tissue: Tissue, data: Term, options: PerTetOptions, b: Floats) -> None:
        self.tissue = tissue
        self.priors = PerTetPriors(tissue, options, b)
        self._data = data
        self._w_b = options.w_b

    def value(self, state: PosedFace) -> float:
        """Return f at a state's estimate."""
        return self._data.value(state.estimate) + self.priors.value(state.pose)

    def quadratic(self, state: PosedFace, tets: Floats, jaw: float) -> Quadratic:
        """Return f's Gauss-Newton model, damped by ``tets`` (n_active,) and ``jaw``."""
        sensitivity = Sensitivity(self.tissue.face, state)
        x = state.estimate
        pose = state.pose
        gradient = sensitivity.response.adjoint(sensitivity.pose, self._data.gradient(x))
        gradient = gradient + self.priors.gradient(pose)
        damping = 2.0 * (tets * self.tissue.volumes)[:, None, None] * stretches.metric(pose.a)
        blocks = self.priors.curvature(pose)[0] + damping
        b = (self._w_b + jaw) * JAW_UNITS**2
        return Quadratic(state, sensitivity, gradient, self._data.curvature(x), blocks, b)
