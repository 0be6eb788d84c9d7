"""The set that S lives on, S of one subject for another, and its mirror prior.

Every row of S is on the unit simplex over its candidate columns. Rows are those of a CSR matrix
given by its ``indptr``; values are its data (nnz,).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from solver.errors import InputError
from solver.fitting.strips import neighbours
from solver.model import OTHER_SIDE, SubjectModel, find_muscles, name_words
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class SimplexOptions:
    """Effort of a minimisation on the simplex, which is not brought to convergence."""

    passes: int = 3  # conjugate gradients, each on a face of the simplex
    iterations: int = 10  # of each at most
    tolerance: float = 0.1  # of each, relative
    halvings: int = 4  # of a step that is projected


def minimise_on_simplex(
    values: Floats,
    gradient: Floats,
    product: Callable[[Floats], Floats],
    indptr: Ints,
    reach: float,
    options: SimplexOptions = SimplexOptions(),
) -> Floats:
    """Return the values that minimise g . d + 1/2 d . H d on the simplex, d their change.

    Values beyond the last row are on no simplex.

    ``gradient`` (nnz,) is g at ``values``, ``product`` multiplies by the positive definite H; no
    value moves by more than ``reach``. Each pass of conjugate gradients is on the face that the one
    before ended on, and projected afterwards (More and Toraldo 1991).
    """
    at = values
    steepest = gradient
    for _ in range(options.passes):
        free = free_entries(at, steepest, indptr)

        def on_face(direction: Floats, free: NDArray[np.bool_] = free) -> Floats:
            return tangent(product(direction), free, indptr)

        shape = (len(values), len(values))
        right = -tangent(steepest, free, indptr)
        system = LinearOperator(shape, matvec=on_face, dtype=np.float64)
        step, _ = cg(system, right, rtol=options.tolerance, maxiter=options.iterations)
        for halving in range(options.halvings):
            goal = np.clip(at + 0.5**halving * step, values - reach, values + reach)
            move = project(goal, indptr) - at
            image = product(move)
            if steepest @ move + 0.5 * move @ image < 0.0:
                break
        else:
            break
        at = at + move
        steepest = steepest + image
    return at


@nb.njit(cache=True, parallel=True)
def project(values: Floats, indptr: Ints) -> Floats:
    """Return the nearest values with s >= 0 and sum 1 in every row (Held, Wolfe, Crowder 1974)."""
    out = values.copy()
    for row in nb.prange(len(indptr) - 1):
        first = indptr[row]
        last = indptr[row + 1]
        descending = np.sort(values[first:last])[::-1]
        total = 0.0
        threshold = 0.0
        for k in range(last - first):
            total += descending[k]
            shift = (total - 1.0) / (k + 1)
            if descending[k] <= shift:
                break
            threshold = shift
        for entry in range(first, last):
            out[entry] = max(values[entry] - threshold, 0.0)
    return out


@nb.njit(cache=True, parallel=True)
def free_entries(values: Floats, gradient: Floats, indptr: Ints) -> NDArray[np.bool_]:
    """Tell which entries may move: not those at zero that the gradient pushes below it.

    The push is the gradient less its mean over the row's free entries, the multiplier of the sum.
    """
    free = np.ones(len(values), dtype=np.bool_)
    for row in nb.prange(len(indptr) - 1):
        first = indptr[row]
        last = indptr[row + 1]
        changed = True
        while changed:
            changed = False
            total = 0.0
            count = 0
            for entry in range(first, last):
                if free[entry]:
                    total += gradient[entry]
                    count += 1
            for entry in range(first, last):
                held = values[entry] <= 0.0 and gradient[entry] * count > total
                if free[entry] and held and count > 1:
                    free[entry] = False
                    changed = True
    return free


@nb.njit(cache=True, parallel=True)
def tangent(values: Floats, free: NDArray[np.bool_], indptr: Ints) -> Floats:
    """Project onto the face's tangent: zero at entries that are not free, rows that sum to zero."""
    out = np.zeros_like(values)
    out[indptr[-1] :] = values[indptr[-1] :]
    for row in nb.prange(len(indptr) - 1):
        total = 0.0
        count = 0
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                total += values[entry]
                count += 1
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                out[entry] = values[entry] - total / count
    return out


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)


def mix_by_stiffness(fractions: sp.csr_array, stiffness: float) -> sp.csr_array:
    """Return S (n, m + 1) of tets that hold parts of muscles, from their volume fractions.

    A tet's parts have the energies k_j phi_ij / 2 |F - R A_j|^2, and their sum is, but for a
    constant, that of one part of stiffness sum_j k_j phi_ij whose shape is the mean of A_j by

        s_ij = k_j phi_ij / sum_l k_l phi_il.

    A contracting muscle's k_j is ``stiffness`` times that of passive flesh: thin muscles pull a
    tet that they fill by a tenth nearly as far as they contract.
    """
    values = np.where(fractions.indices > 0, stiffness, 1.0) * fractions.data
    total = np.bincount(_rows(fractions), values, fractions.shape[0])
    return replace_values(fractions, values / total[_rows(fractions)])


def transfer(S: sp.csr_array, source: SubjectModel, model: SubjectModel) -> sp.csr_array:
    """Return ``source``'s fitted S (n', m' + 1) on ``model``'s pattern, to start its fit from.

    Tet by tet where both have the template's tets, else from the nearest centroid; muscle by
    muscle by name, where only one has compartments the whole muscle. A tet whose candidates have no
    weight there keeps the model's own. Raises :class:`InputError` (``weights.other_muscles``) if no
    muscle is known to both.
    """
    own = model.weights
    there = source.muscle_names
    named = zip(model.muscle_names, model.muscle_groups, strict=True)
    # numbers of the source's muscles, none where it has no such muscle
    columns = [find_muscles(n, there) or find_muscles(whole, there) for n, whole in named]
    if not any(columns):
        raise InputError("weights.other_muscles", "the two subjects have no muscle in common")
    sums = sp.lil_array((S.shape[1], own.shape[1]))
    sums[0, 0] = 1.0
    for column, numbers in enumerate(columns, start=1):
        sums[np.array(numbers, dtype=np.int64) + 1, column] = 1.0
    tets = _rows(own)
    summed = sp.csr_array(S @ sums.tocsr())
    values = np.asarray(summed[_counterparts(source, model)[tets], own.indices]).ravel()
    total = np.add.reduceat(values, own.indptr[:-1])[tets]
    values = np.where(total > 0.0, values, own.data)
    return replace_values(own, project(values, own.indptr))


def _counterparts(source: SubjectModel, model: SubjectModel) -> Ints:
    """Return for every tet of ``model`` the one of ``source`` that stands for it."""
    if np.array_equal(source.tets, model.tets):
        return np.arange(len(model.tets))
    there, here = ((_centres(m) - m.jaw.origin) @ m.jaw.axes.T for m in (source, model))
    return np.asarray(cKDTree(there).query(here)[1])


def _centres(model: SubjectModel) -> Floats:
    return np.asarray(model.rest[model.tets].mean(axis=1))


def _rows(S: sp.csr_array) -> Ints:
    """Return the tet (nnz,) of every value."""
    return np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))


# The symmetric option: muscles of the left and right change alike, as far as the tets allow.
#
# A tet mesh is not its own mirror image, and neither is a person. So the prior
# (w_m/2) sum (ds_ij - ds_i'j')^2 asks only the *changes* ds of S from its start to be alike, at the
# tet i' nearest to the mirrored centroid of tet i and the muscle j' of the other side. The mirror
# is the jaw frame's middle plane.

MIRROR_REACH_MM = 4.0  # a tet further than this from its mirrored place has no counterpart


def mirror_structure(model: SubjectModel, w_m: float) -> sp.csr_array:
    """Return L (k, nnz), so that 1/2 |L ds|^2 is the prior; entries without counterpart are free.

    Raises :class:`InputError` (``model.no_sides``) if no muscle's name tells its side.
    """
    S = model.weights
    names = model.muscle_names
    if not any(word in OTHER_SIDE for name in names for word in name_words(name.lower())):
        raise InputError("model.no_sides", "no muscle's name says left or right: nothing mirrors")
    numbers = replace_values(S, np.arange(1, S.nnz + 1))
    tet = _mirrored_tets(model)[_rows(S)]
    muscle = _mirrored_muscles(names)[S.indices]
    found = np.asarray(numbers[np.maximum(tet, 0), muscle]).ravel() - 1
    paired = np.flatnonzero((tet >= 0) & (found >= 0) & (found != np.arange(S.nnz)))
    pick = sp.eye_array(S.nnz, format="csr")
    return sp.csr_array(np.sqrt(w_m) * (pick[paired] - pick[found[paired]]))


def smooth_structure(model: SubjectModel, w_c: float) -> sp.csr_array:
    """Return L (k, nnz), so that 1/2 |L ds|^2 keeps S smooth where compartments meet.

    The prior (w_c/2) sum (ds_ij - ds_i'j')^2 is over tets i, i' that share a face, and compartments
    j, j' of one muscle: their changes from the start are alike. Whole muscles have no rows.
    """
    S = model.weights
    names = list(dict.fromkeys(model.muscle_groups))
    whole = np.array([0, *(names.index(group) + 1 for group in model.muscle_groups)])
    parts = np.arange(1, S.nnz + 1), whole[S.indices], S.indptr
    numbers = sp.csr_array(parts, shape=(S.shape[0], len(names) + 1))
    one, other = (numbers[tets] for tets in neighbours(model.tets))
    near = sp.coo_array(one * (other > 0))
    first = near.data - 1
    second = other[near.coords].ravel() - 1
    meet = S.indices[first] != S.indices[second]
    pick = sp.eye_array(S.nnz, format="csr")
    return sp.csr_array(np.sqrt(w_c) * (pick[first[meet]] - pick[second[meet]]))


def mirrored_pairs(names: tuple[str, ...]) -> Ints:
    """Return the pairs (k, 2) of muscles whose ``names`` differ by their side; none without sides.

    The first of each pair is that which comes first.
    """
    own = np.arange(len(names))
    other = _mirrored_muscles(names)[1:] - 1
    return np.stack([own, other], axis=1)[own < other]


def _mirrored_muscles(names: tuple[str, ...]) -> Ints:
    """Return each column's mirror image in S: the other side's, or its own in the middle."""
    words = [tuple(name_words(name.lower())) for name in names]
    columns = {name: number for number, name in enumerate(words, start=1)}
    swapped = [tuple(OTHER_SIDE.get(word, word) for word in name) for name in words]
    return np.array([0, *(columns.get(name, own) for own, name in enumerate(swapped, start=1))])


def _mirrored_tets(model: SubjectModel) -> Ints:
    """Return for every tet the nearest to its mirror image, -1 if none is near."""
    centres = _centres(model)
    across = model.jaw.axes[0]
    mirrored = centres - 2.0 * np.outer((centres - model.jaw.origin) @ across, across)
    distance, nearest = cKDTree(centres).query(mirrored)
    return np.where(distance <= MIRROR_REACH_MM, nearest, -1)


# What a caller hands to a face as S. It is checked where a face is made, once.

# by which a row's sum and an entry's sign may be off: differences step off the simplex
WEIGHTS_TOLERANCE = 1e-3


def check_weights(S: sp.csr_array, model: SubjectModel) -> None:
    """Raise :class:`InputError` (``face.weights``) unless S is a muscle geometry of ``model``.

    Its entries are among the model's, which tells rows in another order from those of the model.
    """
    own = model.weights
    if not (sp.issparse(S) and S.format == "csr"):
        raise _weights(f"S is {type(S).__name__}, not a sparse matrix (scipy.sparse.csr_array)")
    if S.shape != own.shape:
        muscles = f"passive flesh and {model.muscle_count} muscles"
        expected = f"{own.shape}: a row for each tet, columns for {muscles}"
        raise _weights(f"S has the shape {S.shape}, not {expected}")
    row = _rows(S)
    names = ("passive flesh", *model.muscle_names)
    for wrong, fault in ((~np.isfinite(S.data), "not finite"), (S.data < 0.0, "negative")):
        for k in np.flatnonzero(wrong & ~(np.abs(S.data) <= WEIGHTS_TOLERANCE))[:1]:
            place = f"row {row[k]}, column {S.indices[k]} ({names[S.indices[k]]})"
            message = f"S is {fault} in {place}: {S.data[k]}"
            raise _weights(message, row=int(row[k]), column=int(S.indices[k]))
    total = np.bincount(row, S.data, len(own.indptr) - 1)
    for k in np.flatnonzero(np.abs(total - 1.0) > WEIGHTS_TOLERANCE)[:1]:
        raise _weights(f"row {k} of S sums to {total[k]:.6g}, not to 1", row=int(k))
    same = np.array_equal(S.indptr, own.indptr) and np.array_equal(S.indices, own.indices)
    if not same:
        own_row = _rows(own)
        places = [each * own.shape[1] for each in (row, own_row)]
        known = np.isin(places[0] + S.indices, places[1] + own.indices) | (S.data == 0.0)
        for k in np.flatnonzero(~known)[:1]:
            message = (
                f"row {row[k]} of S has a share of {names[S.indices[k]]}, which has none there in "
                "the model: are the rows in another order, or S another model's?"
            )
            raise _weights(message, row=int(row[k]), column=int(S.indices[k]))


def _weights(message: str, **context: int) -> InputError:
    return InputError("face.weights", message, **context)
