"""How the equilibrium answers to activations, jaw and muscle geometry.

grad_x E(x; theta) = 0 makes x an implicit function of theta, and

    dx/dtheta = -H^-1 d(grad E)/dtheta.

One factorisation of H serves the dense Jacobian by (a, b) and the products with the Jacobian by S.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose, State
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats, Ints
from solver.threads import in_threads

BLOCK = 64
"""Columns that a symmetric product takes at once."""


@dataclass(frozen=True)
class PoseJacobian:
    """dx/d(a, b): ``flesh`` (size, 6 m + 5) of the free coordinates, ``jaw`` (k, 5) of others.

    ``free`` and ``moving`` (k,) are the places of both among all coordinates (3 p,): what moves
    with the mandible does so by b alone.
    """

    flesh: Floats
    jaw: Floats
    free: Ints
    moving: Ints

    def transposed(self, gradient: Floats) -> Floats:
        """Return (dx/d(a, b))^T g for g by x, (p, 3): shape (6 m + 5,)."""
        flat = gradient.ravel()
        out = self.flesh.T @ flat[self.free]
        out[-self.jaw.shape[1] :] += self.jaw.T @ flat[self.moving]
        return np.asarray(out)

    def contracted(self, curvature: sp.csr_array) -> Floats:
        """Return (dx/d(a, b))^T C dx/d(a, b) for C (3 p, 3 p): shape (6 m + 5, 6 m + 5)."""
        touched = np.flatnonzero(np.diff(curvature.indptr))
        place = np.full(curvature.shape[0], -1)
        place[self.free] = np.arange(len(self.free))
        free = place[touched] >= 0
        rows = np.zeros((len(touched), self.flesh.shape[1]))
        rows[free] = self.flesh[place[touched[free]]]
        place[self.free] = -1
        place[self.moving] = np.arange(len(self.moving))
        moving = place[touched] >= 0
        rows[moving, -self.jaw.shape[1] :] += self.jaw[place[touched[moving]]]
        inner = curvature[touched][:, touched]
        out = np.empty((rows.shape[1], rows.shape[1]))

        def contract(first: int) -> None:
            block = slice(first, first + BLOCK)
            out[first:, block] = rows[:, first:].T @ (inner @ rows[:, block])
            out[block, first:] = out[first:, block].T

        in_threads(contract, range(0, len(out), BLOCK))
        return out


class Sensitivity:
    """The derivatives of the vertices x at one state."""

    def __init__(self, face: Face, state: State) -> None:
        self._face = face
        self._S = face.S
        self._state = state

    def by_pose(self) -> PoseJacobian:
        """Return the derivatives by (a, b); a muscle by muscle, six entries each."""
        face, state = self._face, self._state
        by_tet, numbers = self._by_weight[:2]
        response = state.equilibrium.factor.solve(
            _pose_columns(face.flesh.size, self._S, by_tet, numbers, self._by_jaw[0])
        )
        # in place: on fine meshes new memory takes as long as arithmetic
        np.negative(response, out=response)
        direct = self._by_jaw[1]
        return PoseJacobian(
            response,
            direct.reshape(-1, direct.shape[2]),
            coordinates(face.flesh.free),
            coordinates(face.model.mandible),
        )

    def flesh_by_pose(self, change: Floats) -> Floats:
        """Return the free vertices' change (size,) for a change of (a, b), (6 m + 5,)."""
        by_tet, numbers, indptr, indices, _ = self._by_weight
        columns = np.vstack([np.zeros(6), change[:-5].reshape(-1, 6)])
        pull = self._by_jaw[0] @ change[-5:]
        _forces_by_weights(by_tet, numbers, indptr, indices, columns, self._S.data, pull)
        return -self._state.equilibrium.factor.solve(pull)

    def by_pose_product(self, change: Floats) -> Floats:
        """Return dx/d(a, b) applied to a change of (a, b), (6 m + 5,): motions (p, 3)."""
        out = np.zeros_like(self._state.x)
        out[self._face.flesh.free] = self.flesh_by_pose(change).reshape(-1, 3)
        out[self._face.model.mandible] = self._by_jaw[1] @ change[-5:]
        return out

    def by_pose_adjoint(self, gradient: Floats) -> Floats:
        """Return (dx/d(a, b))^T g for g by x, (p, 3), by one solve: shape (6 m + 5,)."""
        free, mandible = self._face.flesh.free, self._face.model.mandible
        by_tet, numbers = self._by_weight[:2]
        by_jaw, direct = self._by_jaw
        solved = -self._state.equilibrium.factor.solve(gradient[free].ravel())
        by_tet_a = np.empty((len(by_tet), 6))
        _activations_by_forces(by_tet, numbers, solved, by_tet_a)
        by_a = (self._S.T @ by_tet_a)[1:]
        by_b = by_jaw.T @ solved + np.tensordot(gradient[mandible], direct, 2)
        return np.concatenate([by_a.ravel(), by_b])

    def flesh_by_geometry(self, change: Floats) -> Floats:
        """Return the free vertices' change (size,) for a change of S's values (nnz,)."""
        forces = np.zeros(self._face.flesh.size)
        _forces_by_weights(*self._by_weight, change, forces)
        return -self._state.equilibrium.factor.solve(forces)

    def by_geometry_adjoint(self, gradient: Floats) -> Floats:
        """Return the transpose of :meth:`flesh_by_geometry` applied to (size,): shape (nnz,)."""
        adjoint = -self._state.equilibrium.factor.solve(gradient)
        out = np.empty(self._S.nnz)
        _weights_by_forces(*self._by_weight, adjoint, out)
        return out

    @cached_property
    def _by_jaw(self) -> tuple[Floats, Floats]:
        """The free gradient's derivative by b, (size, 5), and the mandible's, (k, 3, 5)."""
        face, state = self._face, self._state
        direct = face.mandible_jacobian(state.pose.b)
        tet_a = face.tet_activations(state.pose.a)
        return face.flesh.coupling(state.x, tet_a, direct), direct[face.model.mandible]

    @cached_property
    def _by_weight(self) -> tuple[Floats, Ints, Ints, Ints, Floats]:
        """What the forces' derivative by S is made of: by tet and activation, and a_j."""
        flesh, pose = self._face.flesh, self._state.pose
        tet_a = self._face.tet_activations(pose.a)
        by_tet = flesh.forces_by_activation(self._state.x, tet_a)
        numbers = flesh.free_numbers[flesh.tets]
        columns = np.vstack([IDENTITY, pose.a])
        return by_tet, numbers, self._S.indptr, self._S.indices, columns


def coordinates(vertices: Ints) -> Ints:
    """Return where the coordinates of ``vertices`` are among all (3 p,)."""
    return np.asarray((3 * vertices[:, None] + np.arange(3)).ravel())


def gradient_by_pose(face: Face, pose: Pose, x: Floats) -> Floats:
    """Return d(grad_x E)/d(a, b) at any x (p, 3), shape (size, 6 m + 5)."""
    flesh = face.flesh
    tet_a = face.tet_activations(pose.a)
    by_jaw = flesh.coupling(x, tet_a, face.mandible_jacobian(pose.b))
    by_tet = flesh.forces_by_activation(x, tet_a)
    return _pose_columns(flesh.size, face.S, by_tet, flesh.free_numbers[flesh.tets], by_jaw)


def _pose_columns(
    size: int, S: sp.csr_array, by_tet: Floats, numbers: Ints, by_jaw: Floats
) -> Floats:
    """Return d(grad_x E)/d(a, b) from the forces' derivatives by tet, and those by b."""
    columns = 6 * (S.shape[1] - 1)
    out = np.zeros((size, columns + by_jaw.shape[1]), order="F")
    _add_by_muscle(by_tet, numbers, S.indptr, S.indices, S.data, out)
    out[:, columns:] = by_jaw
    return out


def gradient_by_geometry(face: Face, pose: Pose, x: Floats) -> sp.csc_array:
    """Return d(grad_x E)/dS at any x (p, 3), (size, nnz).

    Column s_ij holds the forces of tet i by A_i, times a_j: twelve entries, a tet's vertices.
    """
    flesh = face.flesh
    columns = np.vstack([IDENTITY, pose.a])
    by_tet = flesh.forces_by_activation(x, face.tet_activations(pose.a))
    tets = np.repeat(np.arange(len(flesh.tets)), np.diff(face.S.indptr))
    values = np.einsum("eviq,eq->evi", by_tet[tets], columns[face.S.indices])
    return force_columns(values, flesh.free_numbers[flesh.tets[tets]], flesh.size)


def force_columns(forces: Floats, numbers: Ints, size: int) -> sp.csc_array:
    """Return (size, k) with the ``forces`` (k, 4, 3) on a tet's vertices in each column.

    ``numbers`` (k, 4) are the vertices' among the free ones, -1 for one that is held.
    """
    rows = 3 * numbers[:, :, None] + np.arange(3)
    # a held vertex feels no force: its entries are zeroed and go to row 0
    held = rows < 0
    values, rows = np.where(held, 0.0, forces), np.where(held, 0, rows)
    indptr = 12 * np.arange(len(forces) + 1)
    return sp.csc_array((values.ravel(), rows.ravel(), indptr), shape=(size, len(forces)))


@nb.njit(cache=True, nogil=True)
def _activations_by_forces(by_tet: Floats, number: Ints, forces: Floats, out: Floats) -> None:
    """Fill ``out`` (n, 6): the forces (size,) times their derivatives by every tet's activation."""
    for tet in range(len(by_tet)):
        out[tet] = 0.0
        for v in range(4):
            row = 3 * number[tet, v]
            if row < 0:
                continue
            for i in range(3):
                for q in range(6):
                    out[tet, q] += by_tet[tet, v, i, q] * forces[row + i]


@nb.njit(cache=True, nogil=True)
def _forces_by_weights(
    by_tet: Floats,
    number: Ints,
    indptr: Ints,
    indices: Ints,
    columns: Floats,
    change: Floats,
    out: Floats,
) -> None:
    """Add the forces (size,) of a change of A_i = sum_j s_ij a_j, tet by tet.

    ``change`` (nnz,) is that of S's values and ``columns`` (m + 1, 6) are the a_j, or the other way
    round.
    """
    by_a = np.empty(6)
    for tet in range(len(by_tet)):
        by_a[:] = 0.0
        for entry in range(indptr[tet], indptr[tet + 1]):
            for q in range(6):
                by_a[q] += change[entry] * columns[indices[entry], q]
        if not by_a.any():
            continue
        for v in range(4):
            row = 3 * number[tet, v]
            if row < 0:
                continue
            for i in range(3):
                for q in range(6):
                    out[row + i] += by_tet[tet, v, i, q] * by_a[q]


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
    """Fill ``out`` (nnz,) with the transpose of :func:`_forces_by_weights` applied to forces."""
    by_tet_a = np.empty((len(by_tet), 6))
    _activations_by_forces(by_tet, number, forces, by_tet_a)
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
