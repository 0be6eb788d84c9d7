"""Sums of what the tets give to their vertices: element vectors and blocks to the whole mesh.

Every entry is summed in the order of the tets: the result is the same on any number of threads.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
import scipy.sparse as sp

from solver.mechanics.linalg3 import Matrix, add, transpose
from solver.surface import Floats, Ints

# number of a pair of a tet's vertices among those with u <= v: 00 01 02 03 11 12 13 22 23 33
PAIR = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
PAIRS = 10  # their number


class VertexSum:
    """Sums (n, v, 3, ...) over the entries (tets, mostly) of each free vertex.

    ``numbers`` (n, v) are the free vertices' numbers below ``count``, -1 for a held vertex.
    """

    def __init__(self, numbers: Ints, count: int) -> None:
        self._count = count
        self._first, self._corners = _group(numbers.ravel(), count)

    def __call__(self, per_tet: Floats) -> Floats:
        """Return the sums, (3 count, ...)."""
        # not -1: a term may have no entries
        flat = per_tet.reshape(math.prod(per_tet.shape[:2]), math.prod(per_tet.shape[2:]))
        out = np.empty((self._count, flat.shape[1]))
        _sum_rows(flat, self._first, self._corners, out)
        return out.reshape(3 * self._count, *per_tet.shape[3:])


class BlockSum:
    """Sums the tets' blocks of their pairs of vertices to a symmetric CSR matrix of fixed pattern.

    ``pattern`` has three rows and columns for each free vertex, sorted, and its diagonal at
    ``diagonal``. It is that of the ``numbers`` (n, v), see :class:`VertexSum`, or that of another
    sum, ``into``, which has to hold it.
    """

    graph: sp.csr_array  # of the free vertices
    pattern: sp.csr_array

    def __init__(self, numbers: Ints, count: int, into: BlockSum | None = None) -> None:
        u, v = np.triu_indices(numbers.shape[1])
        ends = numbers[:, np.stack([u, v])].transpose(1, 0, 2).reshape(2, -1)
        low = ends.min(axis=0)
        high = ends.max(axis=0)
        free = np.flatnonzero(low >= 0)
        keys = low[free] * count + high[free]
        entries, entry = np.unique(keys, return_inverse=True)
        self._first, contributions = _group(entry, len(entries))
        self._blocks = free[contributions]
        self._turned = ends[0, self._blocks] > ends[1, self._blocks]
        rows, columns = np.divmod(entries, count)
        if into:
            self.graph = into.graph
            self.pattern = into.pattern
        else:
            upper = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
            self.graph = sp.csr_array(upper + upper.T)
            self.graph.sort_indices()
            self.pattern = sp.csr_array(sp.kron(self.graph, np.ones((3, 3)), "csr"))
            self.pattern.sort_indices()
        graph = self.graph
        self.diagonal: Ints = np.flatnonzero(np.equal(*self.pattern.tocoo().coords))
        length = np.diff(graph.indptr).astype(np.int64)
        keys = np.repeat(np.arange(count), length) * count + graph.indices
        within = np.arange(graph.nnz) - np.repeat(graph.indptr[:-1], length)
        start = 9 * np.repeat(graph.indptr[:-1].astype(np.int64), length) + 3 * within
        both = np.stack([entries, columns * count + rows], axis=1)
        self._slots = start[np.searchsorted(keys, both)]
        self._lengths = 3 * np.stack([length[rows], length[columns]], axis=1)

    def __call__(self, blocks: Floats) -> sp.csr_array:
        """Return the sum of ``blocks`` (n, PAIRS, 3, 3), those of the pairs u <= v of each tet."""
        pattern = self.pattern
        data = np.zeros(len(self.pattern.indices))
        self.add(blocks, data)
        return sp.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)

    def add(self, blocks: Floats, data: Floats) -> None:
        """Add the sum of ``blocks`` (n, v (v + 1) / 2, 3, 3) to the pattern's ``data``."""
        flat = np.ascontiguousarray(blocks).reshape(-1, 9)
        groups = self._first, self._blocks, self._turned
        _add_blocks(flat, *groups, self._slots, self._lengths, data)


@nb.njit(cache=True)
def couple(blocks: Floats, tets: Ints, numbers: Ints, motion: Floats, out: Floats) -> None:
    """Add the blocks (t, PAIRS, 3, 3) of some tets times their vertices' ``motion`` (p, 3, k).

    ``numbers`` (t, 4) are the rows of ``out`` (rows, 3, k) for the vertices ``tets`` (t, 4), -1
    where there is none. Entries of one vertex are summed likewise.
    """
    for e in range(len(tets)):
        for u in range(tets.shape[1]):
            row = numbers[e, u]
            if row < 0:
                continue
            for v in range(tets.shape[1]):
                B = blocks[e, PAIR[u, v]]
                for i in range(3):
                    for j in range(3):
                        value = B[i, j] if u <= v else B[j, i]
                        for k in range(out.shape[2]):
                            out[row, i, k] += value * motion[tets[e, v], j, k]


def _group(labels: Ints, count: int) -> tuple[Ints, Ints]:
    """Return where each label's members begin, (count + 1,), and their places; none below 0."""
    members = np.argsort(labels, kind="stable")
    members = members[np.searchsorted(labels[members], 0) :]
    first = np.searchsorted(labels[members], np.arange(count + 1))
    return first, members


@nb.njit(cache=True, parallel=True)
def _sum_rows(flat: Floats, first: Ints, members: Ints, out: Floats) -> None:
    for row in nb.prange(len(out)):
        for column in range(out.shape[1]):
            out[row, column] = 0.0
        for k in range(first[row], first[row + 1]):
            member = members[k]
            for column in range(out.shape[1]):
                out[row, column] += flat[member, column]


@nb.njit(cache=True, parallel=True)
def _add_blocks(
    blocks: Floats,
    first: Ints,
    members: Ints,
    turned: Ints,
    slots: Ints,
    lengths: Ints,
    data: Floats,
) -> None:
    """Add every entry's 3x3 sum to its two places in the symmetric CSR ``data``."""
    for entry in nb.prange(len(slots)):
        total = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for k in range(first[entry], first[entry + 1]):
            block = _load(blocks[members[k]], 0, 3)
            total = add(total, transpose(block) if turned[k] else block)
        place = slots[entry, 0]
        length = lengths[entry, 0]
        total = add(total, _load(data, place, length))
        _store(total, data, place, length)
        _store(transpose(total), data, slots[entry, 1], lengths[entry, 1])


@nb.njit(cache=True, forceinline=True)
def _load(data: Floats, place: int, length: int) -> Matrix:
    """Return the matrix whose rows lie so far apart in ``data``, from ``place`` on."""
    a = data[place:]
    b = data[place + length :]
    c = data[place + 2 * length :]
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@nb.njit(cache=True, forceinline=True)
def _store(X: Matrix, data: Floats, place: int, length: int) -> None:
    """Write a matrix where :func:`_load` reads it."""
    for i in range(3):
        for j in range(3):
            data[place + i * length + j] = X[3 * i + j]
