"""Gauss-Newton steps of the per-tet model: tens of thousands of unknowns, block-diagonal priors.

In the reduced space of z = (a, b) the step solves (R + J^T C J) z = -g, where C is the data term's
curvature, R the regularisers' and J = dx/dz = -H^-1 [G B] the response of the flesh. A product
costs one linear solve each way, so conjugate gradients do it, preconditioned by the same system
before x was eliminated:

    [C   H   E ] [x     ]        G = d(grad E)/da, B = d(grad E)/db, K = G R_a^-1 G^T,
    [H  -K   B ] [lambda]        E = d2 f/dx db
    [E'  B'  Cb] [b     ]

R_a has a 6x6 block for each tet, hence K has the stiffness matrix's pattern. A little of the
identity makes the system quasi-definite, so that any order of elimination is stable (Vanderbei
1995); what this changes, conjugate gradients take back in a few iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import rslab
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import PosedFace
from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.sensitivity import Sensitivity
from solver.surface import Floats, Ints

# multiples of the identity, in balanced units, the first that can be factorised being taken
SHIFTS = (1e-7, 1e-5, 1e-3)
LEAST_SCALE = 1e-3  # of the data's curvature, in balanced units, where damping dwarfs it


@dataclass(frozen=True)
class Quadratic:
    """The Gauss-Newton model at a state: f's gradient by (a, b) and its curvatures."""

    state: PosedFace
    sensitivity: Sensitivity
    gradient: Floats
    data: sp.csr_array  # C (3 p, 3 p)
    a: Floats  # (n_active, 6, 6) R's blocks
    b: Floats  # (5,) R's diagonal

    def product(self, z: Floats) -> Floats:
        """Return (R + J^T C J) z for z = (a, b)."""
        layout = self.state.pose.layout
        a, b = layout.split(z)
        prior = layout.join([np.einsum("eij,ej->ei", self.a, a), self.b * b])
        return self.sensitivity.product(self.data, z) + prior


class SaddleSolver:
    """Finds Gauss-Newton steps; the analysis of the matrix's pattern is kept from step to step."""

    def __init__(self, tissue: Tissue, iterations: int = 25, tolerance: float = 1e-2) -> None:
        self._tissue = tissue
        self._iterations = iterations
        self._tolerance = tolerance
        self._analysis: Any = None
        self._pattern: tuple[Ints, ...] = ()

    def step(self, model: Quadratic) -> Floats:
        """Return the step (6 n_active + 5,) that minimises the ``model``."""
        precondition = self._preconditioner(model)
        found = np.zeros_like(model.gradient)
        residual = -model.gradient
        direction = precondition(residual)
        square = first = float(residual @ direction)
        for _ in range(self._iterations):
            image = model.product(direction)
            length = square / float(direction @ image)
            found = found + length * direction
            residual = residual - length * image
            nearer = precondition(residual)
            previous = square
            square = float(residual @ nearer)
            if square <= self._tolerance**2 * first:
                break
            direction = nearer + square / previous * direction
        return found

    def _preconditioner(self, model: Quadratic) -> Any:
        """Return the map z -> approximately (R + J^T C J)^-1 z."""
        flesh = self._tissue.face.flesh
        active = self._tissue.active
        state = model.state
        free = flesh.free_coordinates
        layout = state.pose.layout
        rates = model.sensitivity.pose
        forces = model.sensitivity.forces
        by_tet = forces.by_tet[active]
        inverse = np.linalg.inv(model.a)
        weighted = np.einsum("euiq,eqr->euir", by_tet, inverse)
        u, v = np.triu_indices(4)
        blocks = np.zeros((len(flesh.tets), len(u), 3, 3))
        blocks[active] = np.einsum("epir,epjr->epij", weighted[:, u], by_tet[:, v])
        K = flesh.block_sum(blocks)
        H = flesh.hessian(state.x, forces.controls, project=not state.equilibrium.minimum)
        C = model.data[free][:, free]
        jaw = rates.held[:, layout["jaw"]]
        E = (model.data[free] @ jaw).toarray()
        Cb = (jaw.T @ (model.data @ jaw)).toarray() + np.diag(model.b)

        # balanced units: x counts p, lambda counts q
        stiffness = H.diagonal().mean()
        compliance = K.diagonal()
        q = 1.0 / np.sqrt(compliance[compliance > 0.0].mean())
        p = 1.0 / (stiffness * q)
        s = 1.0 / np.sqrt(np.diag(Cb))
        solve = self._factor(
            p * p * C, p * q * H, q * q * K, p * E * s, q * rates.by_jaw * s, s[:, None] * Cb * s
        )
        size = flesh.size

        def precondition(z: Floats) -> Floats:
            a, b = layout.split(z)
            weighted = np.einsum("eij,ej->ei", inverse, a)
            right = np.zeros(2 * size + len(b))
            right[size : 2 * size] = -q * rates.product(layout.join([weighted, np.zeros_like(b)]))
            right[2 * size :] = s * b
            solution = solve(right)
            by_a, _ = layout.split(rates.adjoint(q * solution[size : 2 * size]))
            a = weighted - np.einsum("eij,ej->ei", inverse, by_a)
            return layout.join([a, s * solution[2 * size :]])

        return precondition

    def _factor(
        self, C: Any, H: sp.csr_array, K: sp.csr_array, E: Floats, B: Floats, Cb: Floats
    ) -> Any:
        """Factorise the saddle-point matrix; raises :class:`SolveError` if that is singular."""
        size = H.shape[0]
        identity = sp.eye_array(size, format="csr")
        scale = max(float(C.diagonal().max()), LEAST_SCALE)
        for shift in SHIFTS:
            matrix = sp.block_array(
                [
                    [C + shift * scale * identity, None, None],
                    [H, -K - shift * identity, None],
                    [sp.csr_array(E.T), sp.csr_array(B.T), sp.csr_array(np.tril(Cb))],
                ],
                format="csr",
            )
            lower = sp.csc_matrix(sp.tril(matrix))
            lower.sort_indices()
            try:
                return self._analyse(lower).factor(lower.data).solve
            except RuntimeError:
                continue
        raise SolveError("solve.singular", "the step of the per-tet model cannot be solved for")

    def _analyse(self, lower: sp.csc_matrix) -> Any:
        pattern = lower.indptr, lower.indices
        if not (self._pattern and all(map(np.array_equal, self._pattern, pattern))):
            self._pattern = pattern
            self._analysis = rslab.analyze(lower, path="ldlt", ordering="metis", threads=1)
        return self._analysis
