"""The reduced skin: modes of the simulated motions, whose amounts are quadratic in the sliders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from solver.surface import Floats, Ints


@dataclass(frozen=True)
class ReductionOptions:
    """Size of the reduced skin, and how its map is found."""

    modes: int = 64
    ridge: float = 1e-5  # of the mean diagonal of the normal equations
    slope: float = 0.15  # weight of a slope's row: it says what happens so far from its sample


@dataclass(frozen=True)
class ReducedSkin:
    """The skin's motion from the neutral as a function of slider values c (k,).

    It is sum_r q_r basis_r with q = linear c + quadratic (c_i c_j), pairs i <= j in row-major
    order: ``basis`` (r, n, 3) in half precision, ``linear`` (r, k), ``quadratic``
    (r, k (k + 1) / 2) in single.
    """

    basis: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray

    def motion(self, values: Floats) -> Floats:
        """Return the skin's motion (n, 3) in mm."""
        first, second = np.triu_indices(len(values))
        amounts = self.linear @ values + self.quadratic @ (values[first] * values[second])
        return np.tensordot(amounts, self.basis.astype(np.float64), 1)


def modes_of(
    motions: Floats, weights: Floats, options: ReductionOptions = ReductionOptions()
) -> Floats:
    """Return the main modes (r, n, 3) of motions (s, n, 3), orthonormal with ``weights`` (n,)."""
    scaled = motions.reshape(len(motions), -1) * np.repeat(np.sqrt(weights), 3)
    gram = scaled @ scaled.T
    values, vectors = scipy.linalg.eigh(gram)
    kept = np.argsort(values)[::-1][: options.modes]
    kept = kept[values[kept] > 1e-10 * values.max()]
    modes = (vectors[:, kept] / np.sqrt(values[kept])).T @ motions.reshape(len(motions), -1)
    return np.asarray(modes.reshape(len(kept), *motions.shape[1:]))


def quadratic_map(
    values: Floats,
    amounts: Floats,
    slopes: Sequence[Floats | None],
    options: ReductionOptions = ReductionOptions(),
) -> Floats:
    """Return the map (f, r) from features of the sliders to amounts, by ridge regression.

    ``values`` (s, k) and ``amounts`` (s, r) are the samples', ``slopes`` d amounts / d values
    (r, k) of each, where they are known. The features are c_i, then c_i c_j with i <= j.
    """
    count = values.shape[1]
    pairs = np.triu_indices(count)
    rows, rights = [sp.csr_array(features(values, pairs))], [amounts]
    for each, slope in zip(values, slopes, strict=True):
        if slope is not None:
            rows.append(options.slope * feature_slopes(each, pairs))
            rights.append(options.slope * slope.T)
    matrix = sp.csr_array(sp.vstack(rows))
    normal = (matrix.T @ matrix).toarray()
    normal[np.diag_indices_from(normal)] += options.ridge * np.trace(normal) / len(normal)
    return np.asarray(scipy.linalg.solve(normal, matrix.T @ np.vstack(rights), assume_a="pos"))


def features(values: Floats, pairs: tuple[Ints, Ints]) -> Floats:
    """Return the features (s, f) of slider values (s, k)."""
    return np.hstack([values, values[:, pairs[0]] * values[:, pairs[1]]])


def feature_slopes(values: Floats, pairs: tuple[Ints, Ints]) -> sp.csr_array:
    """Return the features' derivatives by each of the values (k,), shape (k, f)."""
    first, second = pairs
    count = len(values)
    columns = count + np.arange(len(first))
    rows = np.concatenate([np.arange(count), first, second])
    places = np.concatenate([np.arange(count), columns, columns])
    data = np.concatenate([np.ones(count), values[second], values[first]])
    shape = (count, count + len(first))
    return sp.csr_array((data, (rows, places)), shape=shape)


def reduce_skin(modes: Floats, table: Floats) -> ReducedSkin:
    """Return the reduced skin of ``modes`` (r, n, 3) and the map (f, r) of their amounts.

    Every mode is scaled to a greatest coordinate of 1, which suits half precision.
    """
    scale = np.abs(modes).max(axis=(1, 2))
    count = int((np.sqrt(9 + 8 * len(table)) - 3) / 2 + 0.5)
    scaled = (table * scale).T.astype(np.float32)
    return ReducedSkin(
        (modes / scale[:, None, None]).astype(np.float16), scaled[:, :count], scaled[:, count:]
    )
