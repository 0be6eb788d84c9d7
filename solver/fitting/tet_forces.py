"""The forces' derivative by what drives the flesh, tet by tet, and its products with S.

One pass over the tets gives d(forces of tet i)/dA_i, from which come the columns of all muscles,
products with a change of muscles or of S, and their transposes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numba as nb
import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.mechanics.flesh import IDENTITY, Flesh
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class TetForces:
    """The forces' derivative by the activations A_i of tets at x (p, 3), with muscles at a."""

    flesh: Flesh
    S: sp.csr_array
    a: Floats  # the muscles' values
    controls: Floats  # what drives the flesh for them
    x: Floats

    @cached_property
    def by_tet(self) -> Floats:
        """The derivative (n, 4, 3, 6)."""
        return self.flesh.elastic.forces_by_activation(self.x, self.controls)

    @cached_property
    def columns(self) -> Floats:
        """Matrices that the columns of S stand for, (m + 1, 6)."""
        return np.vstack([IDENTITY, self.a])

    @cached_property
    def pattern(self) -> tuple[Floats, Ints, Ints, Ints]:
        """The derivative, the free vertices' numbers (n, 4), and the pattern of S."""
        flesh = self.flesh
        S = self.S
        return self.by_tet, flesh.free_numbers[flesh.tets], S.indptr, S.indices


class MuscleRates(Protocol):
    """The free gradient's derivative by the muscles' values."""

    def fill(self, out: Floats) -> None:
        """Add its columns (size, values) to ``out``."""

    def product(self, change: Floats) -> Floats:
        """Return the free gradient's change (size,) for one of the values, in their shape."""

    def adjoint(self, motion: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to (size,), in any shape."""


class BlendedRates(MuscleRates):
    """The derivative by activations a_j (m, 6) that S blends: A_i = sum_j s_ij a_j."""

    def __init__(self, forces: TetForces) -> None:
        self._forces = forces

    @override
    def fill(self, out: Floats) -> None:
        _add_by_muscle(*self._forces.pattern, self._forces.S.data, out)

    @override
    def product(self, change: Floats) -> Floats:
        tets, fractions = self._active
        out = np.zeros(self._forces.flesh.size)
        forces_by_activations(*self._forces.pattern[:2], tets, fractions @ change, out)
        return out

    @override
    def adjoint(self, motion: Floats) -> Floats:
        tets, fractions = self._active
        by_tet_a = np.empty((len(tets), 6))
        _activations_by_forces(*self._forces.pattern[:2], tets, motion, by_tet_a)
        return np.asarray(fractions.T @ by_tet_a)

    @cached_property
    def _active(self) -> tuple[Ints, sp.csr_array]:
        """The tets (k,) with muscle, and their rows of S, (k, m)."""
        muscles = self._forces.S[:, 1:]
        tets = np.flatnonzero(np.diff(muscles.indptr))
        return tets, muscles[tets]


class MatrixRates(MuscleRates):
    """The derivative as a sparse matrix (size, values): of controls that the flesh has itself."""

    def __init__(self, matrix: sp.csr_array) -> None:
        self._matrix = matrix

    @override
    def fill(self, out: Floats) -> None:
        out += self._matrix.toarray()

    @override
    def product(self, change: Floats) -> Floats:
        return np.asarray(self._matrix @ change)

    @override
    def adjoint(self, motion: Floats) -> Floats:
        return np.asarray(self._matrix.T @ motion)


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
def forces_by_activations(
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
def weights_by_forces(
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
