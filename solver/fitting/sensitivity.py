"""Derivatives of an equilibrium by activations, jaw and muscle geometry.

grad_x E(x; theta) = 0 makes x an implicit function of theta. What the forces are by (a, b) and by S
is here; :class:`~solver.mechanics.response.Response` solves for dx/dtheta, one factorisation
serving the dense Jacobian by (a, b) and the products with the Jacobian by S.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numba as nb
import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.objective import Curvature, GramCurvature
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.response import Response, SparseControls
from solver.mechanics.terms import force_columns
from solver.surface import Floats, Ints
from solver.threads import in_threads

BLOCK = 64  # columns that a symmetric product takes at once


@dataclass(frozen=True)
class Jacobian:
    """dx/dq (3 p, k) of the free coordinates and of the others."""

    flesh: Floats  # (size, k)
    held: sp.csr_array  # (3 p, k)
    free: Ints  # (size,) places of the free coordinates among all
    # rows of flesh that were asked for first: a few dozen markers ask for the same in every step
    _few: list[tuple[Ints, Floats]] = field(default_factory=list, compare=False)

    def adjoint(self, gradient: Floats) -> Floats:
        """Return (dx/dq)^T g (k,) for g by x, (p, 3)."""
        flat = gradient.ravel()
        pull, held = flat[self.free], self.held.T @ flat
        for used, rows in self._few:
            if np.count_nonzero(pull[used]) == np.count_nonzero(pull):
                return np.asarray(rows.T @ pull[used] + held)
        return np.asarray(self.flesh.T @ pull + held)

    def motion(self, rows: sp.csr_array) -> Floats:
        """Return A dx/dq (r, k) for sparse ``rows`` A (r, 3 p)."""
        # the derivatives lie column by column: only the few rows that are needed are gathered
        used = np.flatnonzero(np.isin(self.free, rows.indices))
        moved = rows[:, self.free[used]] @ self._rows_of_flesh(used)
        return np.asarray(moved + (rows @ self.held).toarray())

    def _rows_of_flesh(self, used: Ints) -> Floats:
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
        touched = np.flatnonzero(np.diff(curvature.indptr))
        rows = self.held[touched].toarray()
        _, place, number = np.intersect1d(touched, self.free, return_indices=True)
        rows[place] = self.flesh[number]
        inner = curvature[touched][:, touched]
        out = np.empty((rows.shape[1], rows.shape[1]))

        def fill(first: int) -> None:
            block = slice(first, first + BLOCK)
            out[first:, block] = rows[:, first:].T @ (inner @ rows[:, block])
            out[block, first:] = out[first:, block].T

        in_threads(fill, range(0, len(out), BLOCK))
        return out


class TetForces:
    """The forces' derivative by the activations A_i of a face's tets at x (p, 3), tet by tet."""

    def __init__(self, face: Face, pose: Pose, x: Floats) -> None:
        self.face, self.pose, self.x = face, pose, x
        self.controls = face.flesh_controls(pose.a)

    @cached_property
    def by_tet(self) -> Floats:
        """The derivative (n, 4, 3, 6)."""
        return self.face.flesh.elastic.forces_by_activation(self.x, self.controls)

    @cached_property
    def columns(self) -> Floats:
        """Matrices that the columns of S stand for, (m + 1, 6)."""
        return np.vstack([IDENTITY, self.pose.a])

    @cached_property
    def pattern(self) -> tuple[Floats, Ints, Ints, Ints]:
        """The derivative, the free vertices' numbers (n, 4), and the pattern of S."""
        flesh, S = self.face.flesh, self.face.S
        return self.by_tet, flesh.free_numbers[flesh.tets], S.indptr, S.indices


class PoseRates:
    """The derivative by (a, b): :class:`solver.mechanics.response.Controls`."""

    def __init__(self, forces: TetForces) -> None:
        self._forces = forces
        face, pose = forces.face, forces.pose
        self._S, self._layout = face.S, pose.layout
        direct = face.mandible_jacobian(pose.b)
        # the free gradient's derivative by b (size, k)
        self.by_jaw = face.flesh.coupling(forces.x, forces.controls, direct)
        by_jaw = sp.csr_array(direct.reshape(face.model.rest.size, -1))
        ahead = sp.csr_array((len(direct) * 3, pose.a.size))
        self.held = sp.hstack([ahead, by_jaw], format="csr")

    def columns(self) -> Floats:
        """Return d(grad_x E)/d(a, b), (size, k)."""
        out = np.zeros((len(self.by_jaw), self._layout.size), order="F")
        count = self._layout.size - self.by_jaw.shape[1]
        if self._own is None:
            _add_by_muscle(*self._forces.pattern, self._S.data, out)
        else:
            out[:, :count] = self._own.toarray()
        out[:, count:] = self.by_jaw
        return out

    def product(self, change: Floats) -> Floats:
        """Return the free gradient's change (size,) for one of (a, b)."""
        by_a, by_b = self._layout.split(change)
        pull = self.by_jaw @ by_b
        if self._own is not None:
            return np.asarray(pull + self._own @ by_a)
        by_tet, numbers = self._forces.pattern[:2]
        tets, fractions = self._active
        _forces_by_activations(by_tet, numbers, tets, fractions @ by_a, pull)
        return np.asarray(pull)

    def adjoint(self, motion: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to (size,)."""
        if self._own is not None:
            return self._layout.join([self._own.T @ motion, self.by_jaw.T @ motion])
        by_tet, numbers = self._forces.pattern[:2]
        tets, fractions = self._active
        by_tet_a = np.empty((len(tets), 6))
        _activations_by_forces(by_tet, numbers, tets, motion, by_tet_a)
        return self._layout.join([fractions.T @ by_tet_a, self.by_jaw.T @ motion])

    @cached_property
    def _own(self) -> sp.csr_array | None:
        """The derivative (size, m) by controls of the flesh's own, None of activations by S."""
        forces = self._forces
        if not forces.face.has_own_drive:
            return None
        return forces.face.flesh.forces_by_control(forces.x, forces.controls)

    @cached_property
    def _active(self) -> tuple[Ints, sp.csr_array]:
        """The tets (k,) with muscle, and their rows of S, (k, m)."""
        muscles = self._S[:, 1:]
        tets = np.flatnonzero(np.diff(muscles.indptr))
        return tets, muscles[tets]


class WeightRates:
    """The derivative by S's values (nnz,): :class:`solver.mechanics.response.Controls`."""

    def __init__(self, forces: TetForces) -> None:
        self._forces, self._size = forces, forces.face.flesh.size
        self.held = sp.csr_array((forces.x.size, forces.face.S.nnz))

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
        out, S = np.zeros(self._size), self._forces.face.S
        by_tet_a = sp.csr_array((change, S.indices, S.indptr), shape=S.shape) @ self._forces.columns
        by_tet, numbers = self._forces.pattern[:2]
        _forces_by_activations(by_tet, numbers, np.arange(len(by_tet)), by_tet_a, out)
        return out

    def adjoint(self, motion: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to (size,): shape (nnz,)."""
        out = np.empty(self.held.shape[1])
        _weights_by_forces(*self._forces.pattern, self._forces.columns, motion, out)
        return out


class Sensitivity:
    """The derivatives of the vertices x at one state: the ``response`` to ``pose`` and ``weights``.

    One factor serves all.
    """

    def __init__(self, face: Face, state: PosedFace) -> None:
        self.forces = TetForces(face, state.pose, state.x)
        found = state.equilibrium
        self.response = Response(face.flesh, found.factor, minimum=found.minimum)

    @cached_property
    def pose(self) -> PoseRates:
        """The forces by (a, b)."""
        return PoseRates(self.forces)

    @cached_property
    def weights(self) -> WeightRates:
        """The forces by S's values (nnz,)."""
        return WeightRates(self.forces)

    def by_pose(self) -> Jacobian:
        """Return the derivatives by (a, b), six entries a muscle."""
        free = self.forces.face.flesh.free_coordinates
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


@nb.njit(cache=True, nogil=True)
def _activations_by_forces(
    by_tet: Floats, number: Ints, tets: Ints, forces: Floats, out: Floats
) -> None:
    """Fill ``out`` (k, 6): the forces (size,) times their derivatives by A_i of ``tets`` (k,)."""
    for k, tet in enumerate(tets):
        out[k] = 0.0
        for v in range(4):
            row = 3 * number[tet, v]
            if row < 0:
                continue
            for i in range(3):
                for q in range(6):
                    out[k, q] += by_tet[tet, v, i, q] * forces[row + i]


@nb.njit(cache=True, nogil=True)
def _forces_by_activations(
    by_tet: Floats, number: Ints, tets: Ints, by_a: Floats, out: Floats
) -> None:
    """Add the forces (size,) of a change (k, 6) of the activations of ``tets`` (k,)."""
    for k, tet in enumerate(tets):
        for v in range(4):
            row = 3 * number[tet, v]
            if row < 0:
                continue
            for i in range(3):
                for q in range(6):
                    out[row + i] += by_tet[tet, v, i, q] * by_a[k, q]


@nb.njit(cache=True, nogil=True)
def _weights_by_forces(
    by_tet: Floats,
    number: Ints,
    indptr: Ints,
    indices: Ints,
    columns: Floats,
    forces: Floats,
    out: Floats,
) -> None:
    """Fill ``out`` (nnz,): the forces (size,) times their derivatives by S's values."""
    by_tet_a = np.empty((len(by_tet), columns.shape[1]))
    _activations_by_forces(by_tet, number, np.arange(len(by_tet)), forces, by_tet_a)
    for tet in range(len(by_tet)):
        for entry in range(indptr[tet], indptr[tet + 1]):
            out[entry] = 0.0
            for q in range(6):
                out[entry] += by_tet_a[tet, q] * columns[indices[entry], q]


@nb.njit(cache=True)
def _add_by_muscle(
    by_tet: Floats, number: Ints, indptr: Ints, indices: Ints, weights: Floats, out: Floats
) -> None:
    """Add s_ij d(forces of tet i)/dA_i into the six columns of muscle j, (size, 6 m + ...)."""
    for tet in range(len(by_tet)):
        for entry in range(indptr[tet], indptr[tet + 1]):
            first = 6 * (indices[entry] - 1)
            weight = weights[entry]
            if first < 0 or weight == 0.0:
                continue
            for q in range(6):
                for v in range(4):
                    row = 3 * number[tet, v]
                    if row < 0:
                        continue
                    for i in range(3):
                        out[row + i, first + q] += weight * by_tet[tet, v, i, q]
