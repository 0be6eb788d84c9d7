"""The multi-target problem in full space: (x_k, a_k, b_k) of every expression and their common S.

    min  sum_k [data_k(x_k) + regulariser(a_k, b_k)] + w_s/2 |S - S_0|^2 + 1/2 |L (S - S_0)|^2
    with grad_x E(x_k; a_k, b_k, S) = 0,   sum_j s_ij = 1,   s_ij >= 0.

The objective is that of :mod:`solver.fitting.joint`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.fitting.controls import Block, Layout
from solver.fitting.face import Pose, PosedFace
from solver.fitting.joint import GeometryProblem
from solver.fitting.least_squares import Listener
from solver.fitting.reference.expression import ExpressionProblem, IpoptProblem, Solution, solve
from solver.fitting.sensitivity import WeightRates
from solver.fitting.simplex import replace_values
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class GeometryReference(Solution):
    """IPOPT's answer: S, and every expression's pose and x (p, 3)."""

    S: sp.csr_array
    poses: dict[str, Pose]
    x: dict[str, Floats]


def geometry(
    problem: GeometryProblem,
    start: Mapping[str, PosedFace],
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
    listen: Listener | None = None,
) -> GeometryReference:
    """Minimise over S and all expressions, from the face's S and the ``start`` states.

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    full = FullGeometry(problem, listen)
    S = problem.face.S
    begin = [part.start(start[name].pose, start[name].x) for name, part in full.parts.items()]
    first = full.layout.join([*begin, S.data])
    lower = full.layout.lower
    forces = np.zeros(len(full.parts) * problem.face.flesh.size)
    constants = np.concatenate([forces, np.ones(S.shape[0])])
    z, found = solve(full, first, constants, tolerance, max_iterations, lower)
    pieces, fitted = full.split(z)
    poses = {name: part.pose(pieces[name]) for name, part in full.parts.items()}
    x = {name: part.place(pieces[name]) for name, part in full.parts.items()}
    return GeometryReference(S=fitted, poses=poses, x=x, **vars(found)).check()


class FullGeometry(IpoptProblem):
    """Variables (z_1, ..., z_K, values of S); every expression's forces, then the rows' sums."""

    def __init__(self, problem: GeometryProblem, listen: Listener | None = None) -> None:
        super().__init__(listen)
        self._problem = problem
        self._face = problem.face
        self._S = S = problem.face.S
        candidates = replace_values(S, np.ones(S.nnz))
        self.parts = {
            name: ExpressionProblem(problem.face, term, problem.regularisers[name], candidates)
            for name, term in problem.data.items()
        }
        blocks = [Block(f"z_{name}", part.layout.rest) for name, part in self.parts.items()]
        self.layout = Layout((*blocks, Block("S", S.data, lower=0.0)))
        self._firsts = [self.layout[block.name].start for block in blocks]
        # a held vertex feels no force: its entries of the derivative by S are left out
        self._tet = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
        flesh = problem.face.flesh
        self._felt = np.repeat(flesh.free_numbers[flesh.tets][self._tet].ravel() >= 0, 3)
        square = problem.w_s * sp.eye_array(S.nnz) + problem.structure.T @ problem.structure
        self._by_weights = sp.tril(square).tocoo()

    def split(self, z: Floats) -> tuple[dict[str, Floats], sp.csr_array]:
        """Return every expression's variables, and S."""
        *pieces, values = self.layout.split(z)
        return dict(zip(self.parts, pieces, strict=True)), replace_values(self._S, values)

    @override
    def objective(self, z: Floats) -> float:
        pieces, S = self.split(z)
        parts = sum(part.objective(pieces[name]) for name, part in self.parts.items())
        return parts + self._problem.prior_value(S.data)

    @override
    def gradient(self, z: Floats) -> Floats:
        pieces, S = self.split(z)
        parts = [part.gradient(pieces[name]) for name, part in self.parts.items()]
        return self.layout.join([*parts, self._problem.prior_gradient(S.data)])

    def constraints(self, z: Floats) -> Floats:
        """Return every expression's forces, and the sums of the rows of S."""
        pieces, S = self.split(z)
        forces = [part.constraints(pieces[name], S) for name, part in self.parts.items()]
        return np.concatenate([*forces, S.sum(axis=1)])

    def jacobianstructure(self) -> tuple[Ints, Ints]:
        """Return rows and columns of the constraints' derivative."""
        size = self._face.flesh.size
        weights = self.layout.places("S")
        by_weights = self._pull(self._S, self._face.rest_pose(), self._face.model.rest)
        rows = []
        columns = []
        for k, part in enumerate(self.parts.values()):
            by_part = part.jacobianstructure()
            rows += [k * size + by_part[0], k * size + by_weights.indices[self._felt]]
            columns += [self._firsts[k] + by_part[1], np.repeat(weights, 12)[self._felt]]
        rows.append(len(self.parts) * size + self._tet)
        columns.append(weights)
        return np.concatenate(rows), np.concatenate(columns)

    def jacobian(self, z: Floats) -> Floats:
        """Return its entries."""
        pieces, S = self.split(z)
        values = []
        for name, part in self.parts.items():
            piece = pieces[name]
            by_weights = self._pull(S, part.pose(piece), part.place(piece))
            values += [part.jacobian(piece, S), by_weights.data[self._felt]]
        return np.concatenate([*values, np.ones(S.nnz)])

    @override
    def hessianstructure(self) -> tuple[Ints, Ints]:
        parts = zip(self._firsts, self.parts.values(), strict=True)
        pairs = [first + np.array(part.hessianstructure()) for first, part in parts]
        by_weights = self.layout["S"].start + np.array(self._by_weights.coords)
        rows, columns = np.hstack([*pairs, by_weights])
        return rows, columns

    @override
    def hessian(self, z: Floats, multipliers: Floats, factor: float) -> Floats:
        pieces, _ = self.split(z)
        by_part = (part.hessian(pieces[k], multipliers, factor) for k, part in self.parts.items())
        return np.concatenate([*by_part, factor * self._by_weights.data])

    def _pull(self, S: sp.csr_array, pose: Pose, x: Floats) -> sp.csc_array:
        return WeightRates(self._face.with_unchecked_weights(S).tet_forces(pose, x)).matrix()
