"""A linear solver for matrices whose pattern grows: flesh, and what touches at the moment.

The pattern of flesh never changes; contacts come and go. All entries seen so far stay in the
analysed pattern, as zeros where they are not used: most steps then need no new analysis, which
costs as much as a factorisation.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.mechanics.linear import Factor, LinearSolver, analyse
from solver.surface import Floats, Ints

LARGEST = 1.5
"""The pattern over that of the flesh, in entries, from which on it forgets all but the newest."""


class GrowingSolver:
    """Factorises the sum of a matrix of fixed ``pattern`` (sorted CSR) and one of any other.

    ``name`` is the linear solver (:func:`~solver.mechanics.linear.analyse`), ``analyses`` counts
    how often a pattern was analysed.
    """

    def __init__(self, pattern: sp.csr_array, name: str | None = None) -> None:
        self._name = name
        self._size = pattern.shape[0]
        self._fixed = _keys(pattern)
        self.analyses = 0
        self._analyse(self._fixed)

    @property
    def entries(self) -> int:
        """Return how many entries the analysed pattern has."""
        return len(self._known)

    def plus(self, extra: sp.csr_array) -> LinearSolver:
        """Return the solver of matrices of the fixed pattern with ``extra`` (size, size) added."""
        return _Sum(self, extra)

    def factor(self, data: Floats, extra: sp.csr_array) -> Factor:
        """Factorise the matrix with CSR values ``data`` plus the symmetric ``extra`` (size, size).

        No entry of ``extra`` may be stored twice.

        Raises :class:`~solver.mechanics.linear.NotPositiveDefiniteError`.
        """
        keys = _keys(extra)
        places = self._places(keys)
        if places is None:
            whole = _joined(self._known, keys)
            if len(whole) > LARGEST * len(self._fixed):
                whole = _joined(self._fixed, keys)
            self._analyse(whole)
            places = np.searchsorted(self._known, keys)
        values = np.zeros(len(self._known))
        values[places] = extra.data
        values[self._fixed_places] += data
        return self._solver.factor(values)

    def _places(self, keys: Ints) -> Ints | None:
        """Return where entries are in the analysed pattern, None if one of them is not."""
        places, found = _look_up(self._known, keys)
        return places if found.all() else None

    def _analyse(self, keys: Ints) -> None:
        rows, columns = np.divmod(keys, self._size)
        indptr = np.searchsorted(rows, np.arange(self._size + 1))
        pattern = sp.csr_array(
            (np.ones(len(keys)), columns, indptr), shape=(self._size, self._size)
        )
        self._solver: LinearSolver = analyse(pattern, self._name)
        self._known = keys
        self._fixed_places = np.searchsorted(keys, self._fixed)
        self.analyses += 1


class _Sum:
    def __init__(self, solver: GrowingSolver, extra: sp.csr_array) -> None:
        self._solver = solver
        self._extra = extra

    def factor(self, data: Floats) -> Factor:
        return self._solver.factor(data, self._extra)


def _keys(matrix: sp.csr_array) -> Ints:
    """Return row times size plus column of every stored entry."""
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(rows * matrix.shape[1] + matrix.indices)


def _look_up(known: Ints, keys: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Return where each of some keys is, or belongs, in ``known``, sorted, and whether it is."""
    places = np.searchsorted(known, keys)
    return places, known[np.minimum(places, len(known) - 1)] == keys


def _joined(known: Ints, keys: Ints) -> Ints:
    """Return sorted keys with others put in: nearly all are there, and sorting them is dear."""
    new = np.sort(keys[~_look_up(known, keys)[1]])
    return np.insert(known, np.searchsorted(known, new), new)
