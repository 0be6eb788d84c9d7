"""Gauss-Newton steps of the per-tet model: tens of thousands of unknowns, block-diagonal priors.

In the reduced space of z = (a, b) the step solves (R + J^T C J) z = -g, where C is the data term's
curvature, R the regularisers' and J = dx/dz = -H^-1 [G B] the response of the flesh. A product
costs one linear solve each way, so conjugate gradients do it, preconditioned by the same system
before x was eliminated:

    [C   H   E ] [x     ]        G = d(grad E)/da, B = d(grad E)/db, K = G R_a^-1 G^T,
    [H  -K   B ] [lambda]        E = d2 f/dx db
    [E'  B'  Cb] [b     ]

R_a has a 6x6 block for each tet, hence a is eliminated tet by tet and K has the stiffness matrix's
pattern. A little of the identity makes the system quasi-definite, so that any order of elimination
is stable (Vanderbei 1995); what this changes, conjugate gradients take back in a few iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import rslab
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import State
from solver.fitting.per_tet.tissue import Tissue
from solver.fitting.sensitivity import coordinates, force_columns
from solver.mechanics import jaw
from solver.surface import Floats, Ints

SHIFTS = (1e-7, 1e-5, 1e-3)
"""Parts of the identity, in balanced units, the first that can be factorised being taken."""

LEAST_SCALE = 1e-3
"""What counts as the data's curvature, in balanced units, where damping dwarfs it."""


class Response:
    """The derivatives dx/d(a, b) of a tissue's equilibrium at one state, as products."""

    def __init__(self, tissue: Tissue, state: State) -> None:
        face, flesh = tissue.face, tissue.face.flesh
        a = face.tet_activations(state.pose.a)
        self.forces = flesh.forces_by_activation(state.x, a)[tissue.active]
        direct = face.mandible_jacobian(state.pose.b)
        self.by_jaw = flesh.coupling(state.x, a, direct)
        self.jaw = direct[face.model.mandible].reshape(-1, jaw.DEGREES_OF_FREEDOM)
        self.free = coordinates(flesh.free)
        self.moving = coordinates(face.model.mandible)
        self.factor = state.equilibrium.factor
        columns = self.forces.transpose(0, 3, 1, 2).reshape(-1, 4, 3)
        numbers = np.repeat(flesh.free_numbers[flesh.tets[tissue.active]], 6, axis=0)
        self._G = force_columns(columns, numbers, flesh.size)
        self._coordinates = 3 * len(flesh.rest)

    def pull(self, a: Floats, b: Floats) -> Floats:
        """Return G a + B b, the free gradient's change (size,) by a (n_active, 6) and b (5,)."""
        return np.asarray(self._G @ a.ravel() + self.by_jaw @ b)

    def pulled(self, flesh: Floats) -> tuple[Floats, Floats]:
        """Return the transpose of :meth:`pull` applied to (size,): (n_active, 6) and (5,)."""
        return np.asarray(self._G.T @ flesh).reshape(-1, 6), self.by_jaw.T @ flesh

    def motion(self, a: Floats, b: Floats) -> Floats:
        """Return J z: the change of the vertices' coordinates (3 p,)."""
        out = np.zeros(self._coordinates)
        out[self.free] = -self.factor.solve(self.pull(a, b))
        out[self.moving] = self.jaw @ b
        return out

    def transposed(self, gradient: Floats) -> tuple[Floats, Floats]:
        """Return J^T g for g by the coordinates (3 p,): (n_active, 6) and (5,)."""
        by_a, by_b = self.pulled(-self.factor.solve(gradient[self.free]))
        return by_a, by_b + self.jaw.T @ gradient[self.moving]


@dataclass(frozen=True)
class Quadratic:
    """The Gauss-Newton model at a state: f's gradient by (a, b) and its curvatures.

    ``data`` (3 p, 3 p) is C; ``a`` (n_active, 6, 6) and ``b`` (5,) are R's blocks and diagonal.
    """

    response: Response
    gradient: tuple[Floats, Floats]
    data: sp.csr_array
    a: Floats
    b: Floats

    def product(self, a: Floats, b: Floats) -> tuple[Floats, Floats]:
        """Return (R + J^T C J) z for z = (a, b)."""
        by_a, by_b = self.response.transposed(self.data @ self.response.motion(a, b))
        return by_a + np.einsum("eij,ej->ei", self.a, a), by_b + self.b * b


class SaddleSolver:
    """Finds Gauss-Newton steps; the analysis of the matrix's pattern is kept from step to step."""

    def __init__(self, tissue: Tissue, iterations: int = 25, tolerance: float = 1e-2) -> None:
        self._tissue = tissue
        self._iterations = iterations
        self._tolerance = tolerance
        self._analysis: Any = None
        self._pattern: tuple[Ints, Ints] | None = None

    def step(self, model: Quadratic, state: State) -> tuple[Floats, Floats]:
        """Return the step (a, b) that minimises the ``model``, made at ``state``."""
        precondition = self._preconditioner(model, state)
        a, b = np.zeros_like(model.gradient[0]), np.zeros_like(model.gradient[1])
        residual = (-model.gradient[0], -model.gradient[1])
        direction = precondition(*residual)
        square = first = _dot(residual, direction)
        for _ in range(self._iterations):
            image = model.product(*direction)
            length = square / _dot(direction, image)
            a, b = a + length * direction[0], b + length * direction[1]
            residual = residual[0] - length * image[0], residual[1] - length * image[1]
            nearer = precondition(*residual)
            previous, square = square, _dot(residual, nearer)
            if square <= self._tolerance**2 * first:
                break
            ratio = square / previous
            direction = nearer[0] + ratio * direction[0], nearer[1] + ratio * direction[1]
        return a, b

    def _preconditioner(self, model: Quadratic, state: State) -> Any:
        """Return the map (a, b) -> approximately (R + J^T C J)^-1 (a, b)."""
        flesh, response = self._tissue.face.flesh, model.response
        inverse = np.linalg.inv(model.a)
        weighted = np.einsum("euiq,eqr->euir", response.forces, inverse)
        blocks = np.zeros((len(flesh.tets), 4, 4, 3, 3))
        blocks[self._tissue.active] = np.einsum("euir,evjr->euvij", weighted, response.forces)
        K = flesh.assemble(blocks)
        activation = self._tissue.face.tet_activations(state.pose.a)
        H = flesh.hessian(state.x, activation, project=not state.equilibrium.minimum)
        C = model.data[response.free][:, response.free]
        E = model.data[response.free][:, response.moving] @ response.jaw
        Cb = response.jaw.T @ (
            model.data[response.moving][:, response.moving] @ response.jaw
        ) + np.diag(model.b)

        # balanced units: x counts p, lambda counts q
        stiffness = H.diagonal().mean()
        compliance = K.diagonal()
        q = 1.0 / np.sqrt(compliance[compliance > 0.0].mean())
        p = 1.0 / (stiffness * q)
        s = 1.0 / np.sqrt(np.diag(Cb))
        solve = self._factor(
            p * p * C,
            p * q * H,
            q * q * K,
            p * E * s,
            q * response.by_jaw * s,
            s[:, None] * Cb * s,
        )
        size = flesh.size

        def precondition(a: Floats, b: Floats) -> tuple[Floats, Floats]:
            weighted = np.einsum("eij,ej->ei", inverse, a)
            right = np.zeros(2 * size + len(b))
            right[size : 2 * size] = -q * response.pull(weighted, np.zeros_like(b))
            right[2 * size :] = s * b
            solution = solve(right)
            by_a, _ = response.pulled(q * solution[size : 2 * size])
            return weighted - np.einsum("eij,ej->ei", inverse, by_a), s * solution[2 * size :]

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
                return self._analysed(lower).factor(lower.data).solve
            except RuntimeError:
                continue
        raise SolveError("solve.singular", "the step of the per-tet model can not be solved for")

    def _analysed(self, lower: sp.csc_matrix) -> Any:
        if (
            self._pattern is None
            or len(self._pattern[1]) != lower.nnz
            or not np.array_equal(self._pattern[0], lower.indptr)
            or not np.array_equal(self._pattern[1], lower.indices)
        ):
            self._pattern = lower.indptr, lower.indices
            self._analysis = rslab.analyze(lower, path="ldlt", ordering="metis", threads=1)
        return self._analysis


def _dot(left: tuple[Floats, Floats], right: tuple[Floats, Floats]) -> float:
    return float(np.vdot(left[0], right[0]) + left[1] @ right[1])
