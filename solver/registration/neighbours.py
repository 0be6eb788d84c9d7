"""Which vertices share an edge."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.surface import Ints


def adjacency(faces: Ints, count: int) -> sp.csr_array:
    """Return the symmetric (count, count) matrix with 1 for every pair of vertices on an edge."""
    ends = np.roll(faces, 1, axis=1)
    rows = np.concatenate([faces.ravel(), ends.ravel()])
    columns = np.concatenate([ends.ravel(), faces.ravel()])
    graph = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    graph.data[:] = 1.0
    return graph
