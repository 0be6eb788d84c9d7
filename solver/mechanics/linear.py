"""Sparse symmetric linear solvers behind one protocol: a pattern is analysed once."""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Protocol, TypeVar

import numba as nb
import numpy as np
import pymetis
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from solver.errors import InputError
from solver.surface import Floats, Ints

Item = TypeVar("Item")
Result = TypeVar("Result")


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has a pivot that is not positive."""


class Factor(Protocol):
    """The factorisation of one symmetric positive definite matrix K."""

    def solve(self, B: Floats) -> Floats:
        """Return K^-1 B for ``B`` of shape (size,) or (size, k)."""


@dataclass(frozen=True)
class _Solve:
    """A :class:`Factor` by a function."""

    solve: Callable[[Floats], Floats]


class LinearSolver(Protocol):
    """The analysis of one sparsity pattern."""

    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        """Factorise the matrix with these CSR values; raises :class:`NotPositiveDefiniteError`.

        An ``indefinite`` one may have eigenvalues of any sign but zero.
        """


class Rslab(LinearSolver):
    """Supernodal LDL^T in Rust (MIT): by far the fastest with many right-hand sides."""

    dtype = "float64"
    block = 32  # right-hand sides that it gets at once

    def __init__(self, pattern: sp.csr_array, _block: int = 3) -> None:
        import rslab

        # the lower triangle by columns is the upper triangle by rows
        self._keep, indices, indptr = _upper(pattern)
        ones = np.ones(len(indices))
        lower = sp.csc_matrix((ones, indices, indptr), shape=pattern.shape)
        self._analysis: Any = rslab.analyze(
            lower,
            path="ldlt",
            ordering="metis",
            factor_dtype=self.dtype,
            # the factor is the same, bit for bit, with any number of threads
            threads=nb.get_num_threads(),
        )

    @override
    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        try:
            factor = self._analysis.factor(data[self._keep])
        except RuntimeError as error:
            raise NotPositiveDefiniteError(str(error)) from error
        _, negative, zero = factor.inertia
        if zero or (negative and not indefinite):
            raise NotPositiveDefiniteError(f"{negative} negative and {zero} zero pivots")
        return _Solve(partial(self._solve, factor))

    def _solve(self, factor: Any, B: Floats) -> Floats:
        if B.ndim == 1:
            return np.asarray(factor.solve(B))
        # columns in memory order: three times as fast as rows. A factor keeps ten times the memory
        # of the right-hand sides it was given at once. Blocks do not know of each other: any number
        # of threads gives the same
        X = np.empty(B.shape, order="F")

        def solve(first: int) -> None:
            block = slice(first, first + self.block)
            X[:, block] = factor.solve_many(np.asfortranarray(B[:, block]))

        in_threads(solve, range(0, B.shape[1], self.block))
        return X


class _RslabSingle(Rslab):
    """The same in single precision: a fifth faster; sensitivities keep its errors of about 1e-5."""

    dtype = "float32"


class _SuperLU:
    """SciPy's LU on a METIS order (BSD): always there, and the slowest."""

    pivot_threshold = 0.1  # SuperLU's own for symmetric patterns: smaller diagonals are no pivots

    def __init__(self, pattern: sp.csr_array, block: int = 3) -> None:
        self._order = nested_dissection(pattern, block)
        numbers = pattern.copy()
        numbers.data = np.arange(1, len(pattern.indices) + 1)
        permuted = sp.csc_array(numbers[self._order][:, self._order])
        permuted.sort_indices()
        self._from = permuted.data - 1
        self._matrix = permuted.astype(np.float64)

    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        self._matrix.data = data[self._from]
        try:
            lu = scipy.sparse.linalg.splu(
                self._matrix,
                permc_spec="NATURAL",
                diag_pivot_thresh=self.pivot_threshold if indefinite else 0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise NotPositiveDefiniteError(str(error)) from error
        # unpivoted, U's diagonal has the signs of the inertia
        if not (indefinite or (lu.U.diagonal() > 0.0).all()):
            raise NotPositiveDefiniteError("a pivot is not positive")
        return _Solve(partial(self._solve, lu))

    def _solve(self, lu: Any, B: Floats) -> Floats:
        X = np.empty(B.shape)
        X[self._order] = lu.solve(np.ascontiguousarray(B[self._order]))
        return X


class _Cholmod:
    """CHOLMOD by cvxopt (GPL-3, an extra)."""

    def __init__(self, pattern: sp.csr_array, block: int = 3) -> None:
        import cvxopt
        import cvxopt.cholmod

        self._cvxopt: Any = cvxopt
        self._pattern = pattern
        self._block = block
        self._keep, self._rows, indptr = _upper(pattern)
        self._columns = np.repeat(np.arange(pattern.shape[0]), np.diff(indptr))
        cvxopt.cholmod.options["supernodal"] = 2
        self._order = cvxopt.matrix(nested_dissection(pattern, block).tolist(), tc="i")

    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        if indefinite:  # a Cholesky factor does not exist
            return _SuperLU(self._pattern, self._block).factor(data, indefinite=True)
        cholmod = self._cvxopt.cholmod
        places = (self._rows, self._columns)
        lower = self._cvxopt.spmatrix(data[self._keep], *places, self._pattern.shape)
        # a numeric factorisation overwrites its analysis, and a fit keeps several factors alive
        analysis = cholmod.symbolic(lower, p=self._order)
        try:
            cholmod.numeric(lower, analysis)
        except ArithmeticError as error:
            raise NotPositiveDefiniteError(str(error)) from error
        return _Solve(partial(self._solve, analysis))

    def _solve(self, analysis: Any, B: Floats) -> Floats:
        X = self._cvxopt.matrix(np.ascontiguousarray(B.reshape(len(B), -1)))
        self._cvxopt.cholmod.solve(analysis, X)
        return np.array(X).reshape(B.shape)


# Name -> (the package it needs, the solver).
SOLVERS: dict[str, tuple[str, Callable[[sp.csr_array, int], LinearSolver]]] = {
    "rslab": ("rslab", Rslab),
    "rslab-single": ("rslab", _RslabSingle),
    "cholmod": ("cvxopt", _Cholmod),
    "superlu": ("scipy", _SuperLU),
}

# Those in double precision, the fastest first.
DOUBLE = ("rslab", "cholmod", "superlu")


def analyse(pattern: sp.csr_array, name: str | None = None, block: int = 3) -> LinearSolver:
    """Analyse a symmetric pattern (all of it, sorted CSR) with the solver of that ``name``.

    Without a name it is the fastest in double precision. Unknowns come in blocks of ``block``:
    three coordinates of a vertex, or one value. Raises :class:`InputError` (``solver.unknown``,
    ``solver.missing``).
    """
    name = name or next(each for each in DOUBLE if _is_installed(SOLVERS[each][0]))
    if name not in SOLVERS:
        raise InputError("solver.unknown", f"no linear solver {name!r}: one of {list(SOLVERS)}")
    package, solver = SOLVERS[name]
    if not _is_installed(package):
        raise InputError("solver.missing", f"linear solver {name!r} needs the package {package}")
    return solver(pattern, block)


def fastest() -> str:
    """Return the fastest solver that is installed, for work that needs no double precision.

    Equilibria and the activations of one expression do not. S does, and so does the per-tet model.
    """
    fast = ("rslab-single", *DOUBLE)
    return next(name for name in fast if _is_installed(SOLVERS[name][0]))


def nested_dissection(pattern: sp.csr_array, block: int = 3) -> Ints:
    """Return METIS's fill-reducing order of a matrix whose unknowns come in blocks of ``block``.

    Ordering the graph of vertices and expanding takes a quarter of ordering the coordinates.
    """
    graph = sp.csr_array(pattern[::block, ::block])
    graph.setdiag(0)
    graph.eliminate_zeros()
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    order, _ = pymetis.nested_dissection(adjacency)
    return np.asarray((block * np.asarray(order)[:, None] + np.arange(block)).ravel())


def _upper(pattern: sp.csr_array) -> tuple[Ints, Ints, Ints]:
    """Return where the upper triangle lies in the CSR data, and its indices and indptr."""
    rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
    keep = np.flatnonzero(pattern.indices >= rows)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows[keep], minlength=pattern.shape[0]))])
    return keep, pattern.indices[keep], indptr


def _is_installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


class GrowingSolver:
    """Factorises the sum of a matrix of fixed ``pattern`` (sorted CSR) and one of any other.

    The pattern of flesh never changes; contacts come and go. All entries seen so far stay in the
    analysed pattern, as an analysis costs as much as a factorisation. With more than ``largest``
    times the entries of the fixed pattern it forgets all but the newest. ``name`` is the linear
    solver (:func:`analyse`), ``analyses`` counts the analyses, ``known`` are the last one's keys.
    """

    def __init__(
        self, pattern: sp.csr_array, name: str | None = None, largest: float = 1.5
    ) -> None:
        self._name = name
        self._largest = largest
        self._size = pattern.shape[0]
        self._fixed = _keys(pattern)
        self.analyses = 0
        self._analyse(self._fixed)

    def plus(self, extra: sp.csr_array) -> LinearSolver:
        """Return the solver of matrices of the fixed pattern with a symmetric ``extra`` added.

        No entry of ``extra`` (size, size) may be stored twice.
        """
        return _Sum(self, extra)

    def factor(self, data: Floats, extra: sp.csr_array, *, indefinite: bool) -> Factor:
        """See :meth:`LinearSolver.factor`, of the CSR values ``data`` plus ``extra``."""
        keys = _keys(extra)
        if not _are_among(self.known, keys).all():
            whole = _merge(self.known, keys)
            if len(whole) > self._largest * len(self._fixed):
                whole = _merge(self._fixed, keys)
            self._analyse(whole)
        values = np.zeros(len(self.known))
        values[np.searchsorted(self.known, keys)] = extra.data
        values[self._fixed_places] += data
        return self._solver.factor(values, indefinite=indefinite)

    def _analyse(self, keys: Ints) -> None:
        rows, columns = np.divmod(keys, self._size)
        indptr = np.searchsorted(rows, np.arange(self._size + 1))
        shape = self._size, self._size
        pattern = sp.csr_array((np.ones(len(keys)), columns, indptr), shape=shape)
        self._solver: LinearSolver = analyse(pattern, self._name)
        self.known = keys
        self._fixed_places = np.searchsorted(keys, self._fixed)
        self.analyses += 1


@dataclass(frozen=True)
class _Sum:
    solver: GrowingSolver
    extra: sp.csr_array

    def factor(self, data: Floats, *, indefinite: bool = False) -> Factor:
        return self.solver.factor(data, self.extra, indefinite=indefinite)


def _keys(matrix: sp.csr_array) -> Ints:
    """Return row times size plus column of every stored entry."""
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    return np.asarray(rows * matrix.shape[1] + matrix.indices)


def _are_among(known: Ints, keys: Ints) -> NDArray[np.bool_]:
    """Tell which keys are in ``known``, sorted: np.isin would sort them all again."""
    places = np.searchsorted(known, keys)
    return np.asarray(known[np.minimum(places, len(known) - 1)] == keys)


def _merge(known: Ints, keys: Ints) -> Ints:
    """Return sorted keys with others put in: nearly all are there, and sorting them is dear."""
    new = np.sort(keys[~_are_among(known, keys)])
    return np.insert(known, np.searchsorted(known, new), new)


# Who may use several threads: the kernels, and not the linear algebra beside them.


def leave_threads_to_kernels() -> None:
    """Let BLAS work in one thread, in the whole process.

    Its threads wait busily for their next call and keep the kernels' from running: on two cores a
    frame of a sequence took four times as long with both.
    """
    # a child of a confined process may not look at what it has loaded: its parent tells it then, by
    # its environment
    with suppress(PermissionError):
        threadpool_limits(limits=1, user_api="blas")


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return ``work`` of each item, on as many threads as the kernels use; it must let others run.

    Each thread's kernels are then its own alone, and so is all that it hands to threads itself. The
    first error of any is raised.
    """
    if getattr(_THREAD, "is_worker", False):
        return [work(item) for item in items]
    return list(_kept_threads(nb.get_num_threads(), os.getpid()).map(work, items))


_THREAD = threading.local()


@cache
def _kept_threads(count: int, _process: int) -> ThreadPoolExecutor:
    """Return threads of a process that are kept, and with them the memory that they work in."""
    return ThreadPoolExecutor(count, initializer=_begin_thread)


def _begin_thread() -> None:
    _THREAD.is_worker = True
    nb.set_num_threads(1)
