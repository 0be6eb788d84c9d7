"""Harmonic fields over tets: values that are known in some places, carried smoothly everywhere.

    min_u  1/2 int sigma |grad u|^2 + 1/2 sum_r w_r |(R u - t)_r|^2 - f . u

over fields u on the vertices, exact where they are given (hard constraints), nearly so where rows R
ask for targets t (soft ones), with sources f. Where nothing is asked for, no flux leaves. One
factorisation serves any number of fields.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.mechanics.linear import analyse
from solver.surface import Floats, Ints


def laplacian(gradients: Floats, weights: Floats, tets: Ints, count: int) -> sp.csr_array:
    """Return K (count, count), of which 1/2 u^T K u is 1/2 int sigma |grad u|^2.

    ``gradients`` (n, 4, 3) in 1/mm are those of the tets' shape functions, ``weights`` (n,) their
    volumes times the conductivity sigma, ``tets`` (n, 4) numbers of the ``count`` vertices.
    """
    local = weights[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    pairs = np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, 4).ravel()
    return sp.csr_array(sp.coo_array((local.ravel(), pairs), shape=(count, count)))


class HarmonicExtension:
    """The fields of one problem: its ``matrix`` K (p, p), what is ``given``, and soft constraints.

    ``given`` (p,) marks the vertices where values are given; ``rows`` R (r, p) with ``weights`` w
    (r,) are the soft constraints. ``trace`` times the mean of the diagonal is added to it, for
    parts that nothing holds, whose fields are then zero. Raises
    :class:`~solver.mechanics.linear.NotPositiveDefiniteError` for such parts without it.
    """

    def __init__(
        self,
        matrix: sp.csr_array | sp.csc_array,
        given: NDArray[np.bool_] | None = None,
        rows: sp.csr_array | None = None,
        weights: Floats | None = None,
        trace: float = 0.0,
    ) -> None:
        system = sp.csr_array(matrix)
        self._soft: sp.csr_array | None = None
        if rows is not None and weights is not None:
            self._soft = sp.csr_array(rows.T @ sp.diags_array(weights))
            system = system + self._soft @ rows
        if trace:
            system = system + trace * system.diagonal().mean() * sp.eye_array(system.shape[0])
        self._given = np.zeros(system.shape[0], bool) if given is None else given
        self._free = np.flatnonzero(~self._given)
        among_free = sp.csr_array(system)[self._free]
        self._coupling = sp.csr_array(among_free[:, self._given])
        inner = sp.csr_array(among_free[:, self._free])
        inner.sort_indices()
        if len(self._free):
            self._factor = analyse(inner, block=1).factor(inner.data)

    def __call__(
        self,
        values: Floats | None = None,
        *,
        targets: Floats | None = None,
        load: Floats | None = None,
    ) -> Floats:
        """Return u (p, ...).

        ``values`` (p, ...) count where they are given, ``targets`` t are (r, ...), ``load`` f is
        (p, ...); what is left out is zero, and one of the three is needed.
        """
        parts = [each for each in (values, targets, load) if each is not None]
        found = np.zeros((len(self._given), *parts[0].shape[1:]))
        if values is not None:
            found[self._given] = values[self._given]
        if not len(self._free):
            return found
        right = -self._product(self._coupling, found[self._given])
        if targets is not None and self._soft is not None:
            right += self._product(self._soft, targets)[self._free]
        if load is not None:
            right += load.reshape(len(load), -1)[self._free]
        found[self._free] = self._factor.solve(right).reshape(-1, *found.shape[1:])
        return found

    @staticmethod
    def _product(matrix: sp.csr_array, values: Floats) -> Floats:
        """Return the product with fields (k, ...), flat: (rows, number of fields)."""
        width = int(np.prod(values.shape[1:], dtype=np.int64))
        return np.asarray(matrix @ values.reshape(matrix.shape[1], width))
