"""Activations as what they are, symmetric matrices of positive stretches, and steps between them.

S(a) is positive definite: a muscle may shorten a lot, but not through a point to its mirror image.
So lengths are measured relative to the stretch at hand, |dA|_A^2 = tr(A^-1 dA A^-1 dA), and a step
follows the exponential of that metric (Pennec et al. 2006, "A Riemannian framework for tensor
computing", section 3): to first order it is A + dA, but it never leaves these matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.mechanics.linalg3 import symmetric_cofactor
from solver.model import SubjectModel
from solver.surface import Floats

# |S(a)|^2 = sum of these times a^2: an off-diagonal entry stands for two of the matrix
FROBENIUS = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
PLACES = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # in a, of the nine entries of S(a)
# in S(a), of the six entries of a
ROW = [0, 0, 0, 1, 1, 2]
COLUMN = [0, 1, 2, 1, 2, 2]
UNITS = np.eye(6)[:, PLACES].reshape(6, 3, 3)  # the matrices dS/da_q


def matrices(a: Floats) -> Floats:
    """Return S(a), (n, 3, 3), for a of shape (n, 6)."""
    return np.ascontiguousarray(a[:, PLACES].reshape(-1, 3, 3))


def entries(directions: Floats) -> Floats:
    """Return the six entries (..., 6) of d d^T for ``directions`` (..., 3)."""
    return np.asarray(directions[..., ROW] * directions[..., COLUMN])


def map_stretches(a: Floats, function: Callable[[Floats], Floats]) -> Floats:
    """Return the entries (n, 6) of S(a) with a ``function`` of its stretches in their place."""
    values, axes = np.linalg.eigh(matrices(a))
    return with_stretches(function(np.asarray(values)), np.asarray(axes))


def to_logarithms(a: Floats, least: float, most: float = np.inf) -> Floats:
    """Return log S(a) as entries (n, 6), of stretches within ``least`` and ``most``."""
    return map_stretches(a, lambda stretches: np.log(np.clip(stretches, least, most)))


def with_stretches(stretches: Floats, axes: Floats) -> Floats:
    """Return the entries (n, 6) of matrices with values (n, 3) along ``axes`` (n, 3, 3)."""
    return np.asarray(((axes * stretches[:, None]) @ axes.transpose(0, 2, 1))[:, ROW, COLUMN])


def determinants(a: Floats) -> Floats:
    """Return det S(a) for a of shape (n, 6)."""
    return np.asarray(np.sum((a * _cofactors(a))[:, :3], axis=1))


def determinant_gradients(a: Floats) -> Floats:
    """Return d det S(a)/da, (n, 6)."""
    return FROBENIUS * _cofactors(a)


def _cofactors(a: Floats) -> Floats:
    of_columns: Any = symmetric_cofactor.py_func
    return np.stack(of_columns(a.T), axis=1)


def metric(a: Floats) -> Floats:
    """Return the matrices (n, 6, 6) of |dA|_A^2 in the six entries of da."""
    by_entry = np.linalg.inv(matrices(a))[:, None] @ UNITS
    return np.asarray(np.einsum("nqij,nrji->nqr", by_entry, by_entry))


def move(a: Floats, step: Floats) -> Floats:
    """Return the activations (n, 6) that a ``step`` (n, 6) leads to."""
    stretch, frame = np.linalg.eigh(matrices(a))
    root = np.einsum("nik,nk,njk->nij", frame, np.sqrt(stretch), frame)
    inverse = np.einsum("nik,nk,njk->nij", frame, 1.0 / np.sqrt(stretch), frame)
    rate, axes = np.linalg.eigh(inverse @ matrices(step) @ inverse)
    half = root @ axes * np.exp(0.5 * rate)[:, None]
    return np.asarray((half @ half.transpose(0, 2, 1))[:, ROW, COLUMN])


def fibre_tensors(model: SubjectModel, volumes: Floats, S: sp.csr_array) -> Floats:
    """Return the mean of d d^T over every muscle's flesh, (m, 3, 3), d being unit fibre directions.

    NaN for muscles without flesh in S, which keeps the model's pattern, and without fibres.
    """
    out = np.zeros((model.muscle_count + 1, 3, 3))
    if model.fibres is not None:
        volume = S.data * np.repeat(volumes, np.diff(S.indptr))
        outer = volume[:, None, None] * model.fibres[:, :, None] * model.fibres[:, None, :]
        np.add.at(out, S.indices, outer)
    size = np.trace(out[1:], axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.divide(out[1:], size, out=np.full_like(out[1:], np.nan), where=size > 0.0))


@dataclass(frozen=True)
class IsochoricActivations:
    """Activations of m muscles by the stretch of their fibres; they keep the muscles' volume.

        S(a) = exp(K log(stretch)),    K = 3/2 dev(T) / max(T)

    T being the mean of d d^T along the fibres d: parallel fibres come to the stretch, those of a
    ring to its root in their plane, those of all directions do nothing.
    """

    values: Floats  # (m, 3) of K
    axes: Floats  # (m, 3, 3)

    @classmethod
    def of(cls, tensors: Floats) -> IsochoricActivations:
        """Make the activations of muscles from their fibres' ``tensors`` T (m, 3, 3)."""
        values, axes = np.linalg.eigh(tensors)
        deviators = values - values.mean(axis=1, keepdims=True)
        return cls(1.5 * deviators / values.max(axis=1, keepdims=True), np.asarray(axes))

    def __call__(self, stretch: Floats) -> Floats:
        """Return the activations (m, 6) that bring fibres to ``stretch`` (m,)."""
        return with_stretches(stretch[:, None] ** self.values, self.axes)

    def rates(self, stretch: Floats) -> Floats:
        """Return their derivatives (m, 6) by the stretch."""
        return with_stretches(self.values * stretch[:, None] ** (self.values - 1.0), self.axes)


def isochoric_activation(tensor: Floats, stretch: float) -> Floats:
    """Return the activation (6,) of one muscle, by :class:`IsochoricActivations`.

    ``tensor`` (3, 3) is its mean of d d^T.
    """
    return np.asarray(IsochoricActivations.of(tensor[None])(np.array([stretch]))[0])
