"""Muscles of one degree of freedom: contraction along the fibres, as most models of faces have it.

The model that Phace (2017) compares its six degrees of freedom with. A muscle j that contracts by
gamma_j turns its part of a tet, with fibres along f, into

    S_j = gamma_j f f^T + gamma_j^(-1/2) (I - f f^T),

which keeps its volume; A_i = s_i0 I + sum_j s_ij S_j.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.fitting.stretches import COLUMN, FROBENIUS, ROW
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel
from solver.surface import Floats, Ints

LEAST, MOST = 0.3, 1.5
"""Limits of gamma: a muscle shortens to a third and gives way to half as much again."""


def fibre_activations(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> Floats:
    """Return the activations (n, 6) of all tets for contractions ``gamma`` (m,); 1 is relaxed.

    Raises :class:`InputError` (``model.fibres``) for a model without fibres.
    """
    rows, columns = _entries(S)
    along = _along(model, S)
    stretch = np.concatenate([[1.0], gamma])[columns]
    across = 1.0 / np.sqrt(stretch)
    entries = S.data * (stretch - across)
    active = np.stack(
        [np.bincount(rows, entries * along[:, k], minlength=S.shape[0]) for k in range(6)], axis=1
    )
    isotropic = np.bincount(rows, S.data * across, minlength=S.shape[0])
    return np.ascontiguousarray(active + isotropic[:, None] * IDENTITY)


def activation_rates(
    model: SubjectModel, S: sp.csr_array, muscle: int, gamma: float
) -> tuple[Ints, Floats]:
    """Return the tets (t,) that a muscle is in, and how (t, 6) they change with its ``gamma``."""
    rows, columns = _entries(S)
    own = np.flatnonzero(columns == muscle + 1)
    along = _along(model, S)[own]
    across = -0.5 * gamma**-1.5
    return rows[own], S.data[own, None] * (along + across * (IDENTITY - along))


def nearest_fibre(model: SubjectModel, S: sp.csr_array, a: Floats) -> Floats:
    """Return the contractions (m,) along the fibres that activations ``a`` (m, 6) come to.

    They are f^T S(a_j) f, its mean over the muscle's volume, within [:data:`LEAST`, :data:`MOST`].
    Raises as :func:`fibre_activations`.
    """
    rows, columns = _entries(S)
    along = _along(model, S)
    stretch = np.einsum("ek,k,ek->e", along, FROBENIUS, np.vstack([IDENTITY, a])[columns])
    weight = S.data * volumes(model.rest, model.tets)[rows]
    count = S.shape[1]
    whole = np.bincount(columns, weight, minlength=count)
    sums = np.bincount(columns, weight * stretch, minlength=count)
    found = np.where(whole > 0.0, sums / np.where(whole > 0.0, whole, 1.0), 1.0)
    return np.asarray(np.clip(found, LEAST, MOST)[1:])


def _entries(S: sp.csr_array) -> tuple[Ints, Ints]:
    """Return row and column (nnz,) of every stored entry."""
    return np.repeat(np.arange(S.shape[0]), np.diff(S.indptr)), np.asarray(S.indices, np.int64)


def _along(model: SubjectModel, S: sp.csr_array) -> Floats:
    """Return f f^T (nnz, 6) of every stored entry of S."""
    if model.fibres is None or len(model.fibres) != S.nnz:
        raise InputError(
            "model.fibres", "the model has no fibre directions: build it again to use fibre muscles"
        )
    return np.asarray(model.fibres[:, ROW] * model.fibres[:, COLUMN])
