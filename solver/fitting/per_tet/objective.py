"""f of the per-tet model: its regularisers, and its Gauss-Newton model at an equilibrium."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting import stretches
from solver.fitting.face import Pose, State
from solver.fitting.objective import JAW_UNITS, determinant_gradients, determinants
from solver.fitting.per_tet.contraction import PreferredContraction
from solver.fitting.per_tet.damping import Damping
from solver.fitting.per_tet.group_sparsity import GroupSparsity
from solver.fitting.per_tet.saddle import Quadratic, Response
from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.terms import Term
from solver.surface import Floats


@dataclass(frozen=True)
class PerTetOptions:
    """Weights of the regularisers, and when to stop.

    ``w_act``, ``w_sparse`` and ``w_volume`` are in mm^2, ``w_b`` weighs the jaw's change. The fit
    ends after ``max_iterations`` or when steps gain less than ``tolerance`` f.
    """

    w_act: float = 0.01
    w_sparse: float = 1e-3
    w_volume: float = 10.0
    w_b: float = 1e-6
    max_iterations: int = 60
    tolerance: float = 2e-3


class Objective:
    """f as a function of a tissue's state, with its derivatives."""

    def __init__(self, tissue: Tissue, data: Term, options: PerTetOptions, b: Floats) -> None:
        self.tissue = tissue
        self._data = data
        self._options = options
        self._b = b
        self._volumes = tissue.volumes
        self._contraction = PreferredContraction(tissue)
        self._sparsity = GroupSparsity(tissue)

    def contractions(self, a: Floats) -> Floats:
        """Return the muscles' gamma (m,) that minimise f at activations ``a``."""
        return self._contraction.contractions(a)

    def value(self, state: State) -> float:
        """Return f at a state's estimate, every gamma being the best."""
        return self._data.value(state.estimate) + self.prior_value(state.pose)

    def prior_value(self, pose: Pose) -> float:
        """Return the regularisers' sum at a pose."""
        options, a = self._options, pose.a
        det = determinants(a) - 1.0
        jaw = JAW_UNITS * (pose.b - self._b)
        return float(
            options.w_act * self._contraction.value(a, self.contractions(a))
            + options.w_sparse * self._sparsity.value(a)
            + options.w_volume * (self._volumes @ det**2)
            + 0.5 * options.w_b * jaw @ jaw
        )

    def prior_gradient(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return the derivatives of :meth:`prior_value` by a, (n_active, 6), and by b, (5,)."""
        options, a = self._options, pose.a
        by_a = options.w_act * self._contraction.gradient(a, self.contractions(a))
        by_a = by_a + options.w_sparse * self._sparsity.gradient(a)
        stretch = 2.0 * options.w_volume * self._volumes * (determinants(a) - 1.0)
        by_a = by_a + stretch[:, None] * determinant_gradients(a)
        return by_a, options.w_b * JAW_UNITS**2 * (pose.b - self._b)

    def prior_blocks(self, a: Floats) -> Floats:
        """Return the Gauss-Newton Hessian of :meth:`prior_value` by each tet's a, (n_active, 6, 6).

        The contractions are held, and the parabolas of R_sparse stand for it.
        """
        options, slopes = self._options, determinant_gradients(a)
        volume = 2.0 * options.w_volume * self._volumes
        blocks = volume[:, None, None] * slopes[:, :, None] * slopes[:, None, :]
        diagonal = options.w_act * self._contraction.curvature()
        blocks[:, np.arange(6), np.arange(6)] += diagonal
        blocks[:, np.arange(6), np.arange(6)] += options.w_sparse * self._sparsity.curvature(a)
        return np.asarray(blocks)

    def quadratic(self, state: State, damping: Damping) -> Quadratic:
        """Return the Gauss-Newton model of f at a state, damped."""
        options, a = self._options, state.pose.a
        response = Response(self.tissue, state)
        by_a, by_b = response.transposed(self._data.gradient(state.estimate).ravel())
        prior_by_a, prior_by_b = self.prior_gradient(state.pose)
        blocks = self.prior_blocks(a)
        blocks += 2.0 * (damping.tets * self._volumes)[:, None, None] * stretches.metric(a)
        return Quadratic(
            response,
            (by_a + prior_by_a, by_b + prior_by_b),
            self._data.curvature(state.estimate),
            blocks,
            (options.w_b + damping.jaw) * JAW_UNITS**2,
        )
