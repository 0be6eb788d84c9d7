"""S as values on a fixed pattern, the candidates of every tet; and S of one subject for another."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from solver.errors import InputError
from solver.fitting import simplex
from solver.model import SubjectModel
from solver.surface import Floats, Ints


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)


def transferred(S: sp.csr_array, source: SubjectModel, model: SubjectModel) -> sp.csr_array:
    """Return ``source``'s fitted S (n', m' + 1) on ``model``'s pattern, to start its fit from.

    Tet by tet where both have the template's tets, else from the nearest centroid; muscle by
    muscle by name. A tet whose candidates have no weight there keeps the model's own. Raises
    :class:`InputError` (``weights.other_muscles``) if no muscle is known to both.
    """
    own = model.weights
    tets = np.repeat(np.arange(own.shape[0]), np.diff(own.indptr))
    column = _columns(source.muscle_names, model.muscle_names)[own.indices]
    found = np.asarray(S[_counterparts(source, model)[tets], np.maximum(column, 0)]).ravel()
    values = np.where(column >= 0, found, 0.0)
    total = np.add.reduceat(values, own.indptr[:-1])[tets]
    values = np.where(total > 0.0, values, own.data)
    return replace_values(own, simplex.project(values, own.indptr))


def _columns(source: tuple[str, ...], names: tuple[str, ...]) -> Ints:
    """Return for every column of ``names`` that of ``source``, -1 where it has no such muscle."""
    numbers = {name: number for number, name in enumerate(source, start=1)}
    if not set(numbers) & set(names):
        raise InputError("weights.other_muscles", "the two subjects have no muscle in common")
    return np.array([0, *(numbers.get(name, -1) for name in names)])


def _counterparts(source: SubjectModel, model: SubjectModel) -> Ints:
    """Return for every tet of ``model`` the one of ``source`` that stands for it."""
    if np.array_equal(source.tets, model.tets):
        return np.arange(len(model.tets))
    there, here = (_centres(subject) for subject in (source, model))
    return np.asarray(cKDTree(there).query(here)[1])


def _centres(model: SubjectModel) -> Floats:
    """Return the tets' centroids in the frame of the jaw."""
    return np.asarray((model.rest[model.tets].mean(axis=1) - model.jaw.origin) @ model.jaw.axes.T)
