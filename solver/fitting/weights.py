"""S as values on a fixed pattern: the candidates of every tet."""

from __future__ import annotations

import scipy.sparse as sp

from solver.surface import Floats


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)
