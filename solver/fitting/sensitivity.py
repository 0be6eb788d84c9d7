"""Derivatives of an equilibrium by activations, jaw and muscle geometry.

grad_x E(x; theta) = 0 makes x an implicit function of theta. This module has the derivatives of
the forces by (a, b) and by S; :class:`~solver.mechanics.response.Response` solves for dx/dtheta,
one factorisation serving the dense Jacobian by (a, b) and the products with the Jacobian by S.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.objective import Curvature, GramCurvature
from solver.fitting.tet_forces import TetForces, forces_by_activations, weights_by_forces
from solver.mechanics.linear import in_threads
from solver.mechanics.response import Response, SparseControls
from solver.mechanics.terms import force_columns
from solver.surface import Floats, Ints

BLOCK = 64  # columns that a symmetric product takes at once


@dataclass(frozen=True)
class CurvatureImage:
    """C J of a curvature C (3 p, 3 p) and a Jacobian J, and J^T C J."""

    free: Ints  # (r,) those free coordinates whose rows of C are not zero
    rows: Floats  # (r, k) of C J
    contracted: Floats  # (k, k)


@dataclass(frozen=True)
class Jacobian:
    """dx/dq (3 p, k) of the free coordinates and of the others."""

    flesh: NDArray[np.floating]  # (size, k)
    held: sp.csr_array  # (3 p, k)
    free: Ints  # (size,) places of the free coordinates among all
    # rows of flesh that were asked for first: data ask for the same in every step
    _few: list[tuple[Ints, NDArray[np.floating]]] = field(
        init=False, default_factory=list, compare=False
    )

    def in_single_precision(self) -> Jacobian:
        """Halve the time of reading it; what corrects the flesh takes up the rounding."""
        return replace(self, flesh=self.flesh.astype(np.float32))

    def plus(self, change: NDArray[np.floating]) -> Jacobian:
        """Return the derivatives with those of the free coordinates changed by (size, k)."""
        other = replace(self, flesh=self.flesh + change)
        other._few.extend((used, other.flesh[used]) for used, _ in self._few)
        return other

    def flesh_motion(self, change: Floats) -> Floats:
        """Return the free coordinates' motion (size,) for a ``change`` (k,) of q."""
        return np.asarray(self.flesh @ change.astype(self.flesh.dtype), np.float64)

    def adjoint(self, gradient: Floats) -> Floats:
        """Return (dx/dq)^T g (k,) for g by x, (p, 3)."""
        flat = gradient.ravel()
        pull = flat[self.free]
        held = self.held.T @ flat
        for used, rows in self._few:
            if np.count_nonzero(pull[used]) == np.count_nonzero(pull):
                return np.asarray(rows.T @ pull[used].astype(rows.dtype) + held)
        return np.asarray(self.flesh.T @ pull.astype(self.flesh.dtype) + held)

    def motion(self, rows: sp.csr_array) -> Floats:
        """Return A dx/dq (r, k) for sparse ``rows`` A (r, 3 p)."""
        # the derivatives lie column by column: only the few rows that are needed are gathered
        used = np.flatnonzero(np.isin(self.free, rows.indices))
        moved = rows[:, self.free[used]] @ self._rows_of_flesh(used)
        return np.asarray(moved + (rows @ self.held).toarray())

    def _rows_of_flesh(self, used: Ints) -> NDArray[np.floating]:
        if self._few and np.array_equal(self._few[0][0], used):
            return self._few[0][1]
        rows = self.flesh[used]
        if not self._few and 4 * len(used) < len(self.free):
            self._few.append((used, rows))
        return rows

    def contract(self, curvature: Curvature) -> Floats:
        """Return (dx/dq)^T C dx/dq (k, k) for C (3 p, 3 p)."""
        if isinstance(curvature, GramCurvature):
            moved = self.motion(curvature.rows)
            return np.asarray(moved.T @ (curvature.inner @ moved))
        return self.image(curvature).contracted

    def image(self, curvature: sp.csr_array) -> CurvatureImage:
        """Return C dx/dq for C (3 p, 3 p), and what it contracts to."""
        touched = np.flatnonzero(np.diff(curvature.indptr))
        rows = self.held[touched].toarray()
        _, place, number = np.intersect1d(touched, self.free, return_indices=True)
        seen = self.flesh[number]
        rows[place] = seen
        if not self._few:
            self._few.append((number, seen))
        inner = curvature[touched][:, touched]
        image = np.empty(rows.shape, order="F")
        out = np.empty((rows.shape[1], rows.shape[1]))

        def fill(first: int) -> None:
            block = slice(first, first + BLOCK)
            image[:, block] = inner @ rows[:, block]
            out[first:, block] = rows[:, first:].T @ image[:, block]
            out[block, first:] = out[first:, block].T

        in_threads(fill, range(0, len(out), BLOCK))
        return CurvatureImage(number, image[place], out)


class PoseRates:
    """The derivative by (a, b): :class:`solver.mechanics.response.FleshControls`."""

    def __init__(self, face: Face, forces: TetForces, pose: Pose) -> None:
        self._layout = pose.layout
        self._muscles = face.drive.rates(forces)
        direct = face.mandible_jacobian(pose.b)
        # the free gradient's derivative by b (size, k)
        self.by_jaw = face.flesh.coupling(forces.x, forces.controls, direct)
        by_jaw = sp.csr_array(direct.reshape(face.model.rest.size, -1))
        ahead = sp.csr_array((len(direct) * 3, pose.a.size))
        self.held = sp.hstack([ahead, by_jaw], format="csr")

    def columns(self) -> Floats:
        """Return d(grad_x E)/d(a, b), (size, k)."""
        out = np.zeros((len(self.by_jaw), self._layout.size), order="F")
        self._muscles.fill(out[:, : self._count])
        out[:, self._count :] = self.by_jaw
        return out

    @property
    def _count(self) -> int:
        """The number of the muscles' entries, which come first."""
        return self._layout.drive.rest.size

    def product(self, change: Floats) -> Floats:
        """Return the free gradient's change (size,) for one of (a, b)."""
        by_a = self._layout.part(self._layout.drive.name, change)
        return np.asarray(self.by_jaw @ change[self._count :] + self._muscles.product(by_a))

    def adjoint(self, motion: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to (size,)."""
        return self._layout.join([self._muscles.adjoint(motion), self.by_jaw.T @ motion])


class WeightRates:
    """The derivative by S's values (nnz,): :class:`solver.mechanics.response.FleshControls`."""

    def __init__(self, forces: TetForces) -> None:
        self._forces = forces
        self._size = forces.flesh.size
        self.held = sp.csr_array((forces.x.size, forces.S.nnz))

    def matrix(self) -> sp.csc_array:
        """Return d(grad_x E)/dS, (size, nnz).

        Column s_ij holds the forces of tet i by A_i, times a_j: twelve entries, a tet's vertices.
        """
        by_tet, numbers, indptr, indices = self._forces.pattern
        tets = np.repeat(np.arange(len(by_tet)), np.diff(indptr))
        values = np.einsum("eviq,eq->evi", by_tet[tets], self._forces.columns[indices])
        return force_columns(values, numbers[tets], self._size)

    def columns(self) -> Floats:
        """Return :meth:`matrix`, dense."""
        return np.asarray(self.matrix().toarray(order="F"))

    def product(self, change: Floats) -> Floats:
        """Return the free gradient's change (size,) for one of S's values (nnz,)."""
        out = np.zeros(self._size)
        S = self._forces.S
        by_tet_a = sp.csr_array((change, S.indices, S.indptr), shape=S.shape) @ self._forces.columns
        by_tet, numbers = self._forces.pattern[:2]
        forces_by_activations(by_tet, numbers, np.arange(len(by_tet)), by_tet_a, out)
        return out

    def adjoint(self, motion: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to (size,): shape (nnz,)."""
        out = np.empty(self.held.shape[1])
        weights_by_forces(*self._forces.pattern, self._forces.columns, motion, out)
        return out


class Sensitivity:
    """The derivatives of the vertices x at one state: the ``response`` to ``pose`` and ``weights``.

    One factor serves all.
    """

    def __init__(self, face: Face, state: PosedFace) -> None:
        self.face = face
        self.state = state
        self.forces = face.tet_forces(state.pose, state.x)
        found = state.equilibrium
        self.response = Response(face.flesh, found.factor, minimum=found.minimum)

    @cached_property
    def pose(self) -> PoseRates:
        """The forces by (a, b)."""
        return PoseRates(self.face, self.forces, self.state.pose)

    @cached_property
    def weights(self) -> WeightRates:
        """The forces by S's values (nnz,)."""
        return WeightRates(self.forces)

    def by_pose(self) -> Jacobian:
        """Return the derivatives by (a, b), six entries a muscle."""
        free = self.face.flesh.free_coordinates
        return Jacobian(self.response.columns(self.pose), self.pose.held, free)

    def product(self, curvature: Curvature, change: Floats) -> Floats:
        """Return J^T C J applied to a change of (a, b), for C (3 p, 3 p) and J = dx/d(a, b)."""
        pull = curvature @ self.response.product(self.pose, change).ravel()
        return self.response.adjoint(self.pose, pull)

    def motions_along(self, directions: Floats) -> Floats:
        """Return the derivatives (p, 3, k) along ``directions`` of (a, b), (6 m + 5, k)."""
        forces = sp.csc_array(self.pose.columns() @ directions)
        held = sp.csr_array(self.pose.held @ sp.csr_array(directions))
        return self.response.motions(SparseControls(forces, held))


def coordinates(vertices: Ints) -> Ints:
    """Return where the coordinates of ``vertices`` are among all (3 p,)."""
    return np.asarray((3 * vertices[:, None] + np.arange(3)).ravel())
