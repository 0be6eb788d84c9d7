"""Few shapes that span many skins, so that a frame or a slider's pose is a few weights.

A truncated singular value decomposition has the least mean error; what shows is the greatest. So
vertices that are furthest off are weighed up until the greatest error is small enough (iteratively
reweighted least squares), and where that does not help a few shapes more are taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from solver.surface import Floats, Ints, Surface, vertex_normals

Singles = NDArray[np.float32]

BLOCK = 64  # frames that are looked at together


@dataclass(frozen=True)
class SkinBasisOptions:
    """Number and accuracy of the shapes that span many skins."""

    within_mm: float = 0.1  # a vertex may be so far off
    most_shapes: int = 256  # with so many it may be further off: 0.2 GB of 27,000 vertices
    first_shapes: int = 6  # tried first
    more_shapes: float = 1.4  # so many times as many are tried next
    reweightings: int = 2  # before there are more shapes
    last_reweightings: int = 8  # where there may be no more shapes
    least_importance: float = 1e-3  # of a coordinate, by the mean: all of them count
    most_samples: int = 400  # frames that shapes are made of, evenly taken; they make all frames
    more_samples: int = 50  # that are further off are taken in then, the furthest first
    samplings: int = 8  # times that shapes are made at most
    still_mm: float = 1e-3  # what moves less is left out, a vertex or a shape
    smallest_shape: float = 1e-9  # square of a shape, by the greatest, that counts as none
    ridge: float = 1e-6  # of the weights' greatest variance: keeps normals small where shapes hide


@dataclass(frozen=True)
class Basis:
    """Skins are about neutral + weights @ shapes at the vertices ``moving`` (k,); others are still.

    ``shapes`` (s, k, 3) are in mm, ``weights`` (f, s) lie between 0 and 1 and reach both, but for
    the first one's, which is 1 throughout: that shape is what all others count from.
    """

    moving: Ints
    shapes: Singles
    weights: Floats


def span_skins(
    neutral: Surface, skins: Singles, options: SkinBasisOptions = SkinBasisOptions()
) -> Basis:
    """Return a basis of ``skins`` (f, v, 3), mm, with no vertex further off than the options say.

    Unless there are ``most_shapes``, or frames that were not sampled ask for more.
    """
    moving = _moving(neutral, skins, options.still_mm)
    chosen = _samples(len(skins), options)
    for _ in range(options.samplings):
        basis = _span(neutral, skins, moving, chosen, options)
        errors = _errors(neutral, skins, basis)
        errors[chosen] = 0.0  # of these the shapes were made
        worst = np.argsort(errors)[::-1][: options.more_samples]
        beyond = worst[errors[worst] > options.within_mm]
        if not len(beyond):
            break
        chosen = np.union1d(chosen, beyond)
    return basis


def _span(
    neutral: Surface, skins: Singles, moving: Ints, chosen: Ints, options: SkinBasisOptions
) -> Basis:
    """Return a basis of all skins by shapes that are made of those ``chosen`` (k,)."""
    samples = _motion(neutral, skins[chosen], moving)
    directions, importance = _directions(samples, options)
    towards = (directions * importance).astype(np.float64)
    # skins of fewer dimensions leave shapes of nothing
    solve = np.linalg.pinv(towards @ directions.T, rcond=options.smallest_shape, hermitian=True)
    amounts = np.vstack(
        [_motion(neutral, block, moving) @ towards.T @ solve for block in _blocks(skins)]
    )
    least = amounts.min(axis=0)
    most = amounts.max(axis=0)
    longest = np.linalg.norm(directions.reshape(len(directions), -1, 3), axis=2).max(axis=1)
    used = (most - least) * longest > options.still_mm
    span = (most - least)[used]
    start = least @ directions
    shapes = np.vstack([start[None], span[:, None] * directions[used]])
    weights = np.hstack([np.ones((len(amounts), 1)), (amounts - least)[:, used] / span])
    return Basis(moving, shapes.reshape(-1, len(moving), 3).astype(np.float32), weights)


def normal_shapes(
    neutral: Surface, skins: Singles, basis: Basis, options: SkinBasisOptions = SkinBasisOptions()
) -> Singles:
    """Return changes of the moving vertices' normals (s, k, 3), whose blend is the skins' normals.

    They are the least squares over frames of the animation: normals are not linear in the motion.
    """
    chosen = _samples(len(skins), options)
    at_rest = vertex_normals(neutral)[basis.moving]
    weights = basis.weights[chosen]
    right = np.zeros((weights.shape[1], at_rest.size))
    for row, frame in zip(weights, chosen, strict=True):
        surface = neutral.with_vertices(skins[frame].astype(np.float64))
        right += row[:, None] * (vertex_normals(surface)[basis.moving] - at_rest).ravel()
    gram = weights.T @ weights
    gram[np.diag_indices_from(gram)] += options.ridge * gram.max()
    changes = np.linalg.solve(gram, right)
    return changes.reshape(-1, *at_rest.shape).astype(np.float32)


def _errors(neutral: Surface, skins: Singles, basis: Basis) -> Floats:
    """Return how far a vertex of each of ``skins`` (f, v, 3) is off what the basis makes, mm."""
    shapes = basis.shapes.reshape(len(basis.shapes), -1)
    found = []
    for block, weights in zip(_blocks(skins), _blocks(basis.weights), strict=True):
        off = _motion(neutral, block, basis.moving) - weights.astype(np.float32) @ shapes
        found.append(np.linalg.norm(off.reshape(len(off), -1, 3), axis=2).max(axis=1))
    return np.concatenate(found).astype(np.float64)


def _directions(samples: Singles, options: SkinBasisOptions) -> tuple[Singles, Singles]:
    """Return shapes (s, 3 k) that make ``samples`` (f, 3 k), and what coordinates (3 k,) count."""
    importance = np.ones(samples.shape[1], np.float32)
    most = min(options.most_shapes, len(samples))
    least = np.float32(options.least_importance)
    count = min(options.first_shapes, most)
    tries = 0
    while True:
        gram = ((samples * importance) @ samples.T).astype(np.float64)
        along = np.linalg.eigh(gram)[1][:, -count:].astype(np.float32)
        directions = along.T @ samples
        off = (samples - along @ directions).reshape(len(samples), -1, 3)
        errors = np.linalg.norm(off, axis=2).max(axis=0)
        tries += 1
        if errors.max() <= options.within_mm or (
            count == most and tries == options.last_reweightings
        ):
            return directions, importance
        if tries >= options.reweightings and count < most:
            count = min(int(options.more_shapes * count), most)
            tries = 0
        importance = importance * np.repeat(errors / errors.mean(), 3)
        importance = np.maximum(importance / importance.mean(), least)


def _samples(frames: int, options: SkinBasisOptions) -> Ints:
    return np.unique(np.linspace(0, frames - 1, options.most_samples).round().astype(int))


def _moving(neutral: Surface, skins: Singles, still_mm: float) -> Ints:
    """Return the vertices that leave their place; one, if all are still."""
    vertices = neutral.vertices.astype(np.float32)
    most = np.zeros(len(vertices), np.float32)
    for block in _blocks(skins):
        most = np.maximum(most, np.abs(block - vertices).max(axis=(0, 2)))
    moving = np.flatnonzero(most > still_mm)
    return moving if len(moving) else np.zeros(1, np.int64)


def _motion(neutral: Surface, skins: Singles, vertices: Ints) -> Singles:
    """Return how far ``vertices`` (k,) are from the neutral in each skin, (f, 3 k)."""
    at_rest = neutral.vertices[vertices].astype(np.float32)
    return np.asarray((skins[:, vertices] - at_rest).reshape(len(skins), -1))


def _blocks(frames: np.ndarray) -> Iterator[np.ndarray]:
    return (frames[first : first + BLOCK] for first in range(0, len(frames), BLOCK))


# The skin reduced for sliders: modes of simulated motions, their amounts quadratic in the sliders.


@dataclass(frozen=True)
class ReductionOptions:
    """Size of the reduced skin, and how its map is found."""

    modes: int = 64
    ridge: float = 1e-5  # of the mean diagonal of the normal equations
    slope: float = 0.15  # weight of a slope's row: it says what happens so far from its sample


@dataclass(frozen=True)
class ReducedSkin:
    """The skin's motion from the neutral as a function of slider values c (k,).

    It is sum_r q_r basis_r with q = linear c + quadratic (c_i c_j), pairs i <= j by rows.
    """

    basis: np.ndarray  # (r, n, 3) in half precision
    linear: np.ndarray  # (r, k) in single
    quadratic: np.ndarray  # (r, k (k + 1) / 2)

    def motion(self, values: Floats) -> Floats:
        """Return the skin's motion (n, 3) in mm."""
        return np.tensordot(self.amounts(values), self.basis.astype(np.float64), 1)

    def amounts(self, values: Floats) -> Floats:
        """Return q (r,)."""
        return np.asarray((self.linear + self._bend(values)) @ values)

    def amount_rates(self, values: Floats) -> Floats:
        """Return the derivative of q by the sliders, (r, k)."""
        return np.asarray(self.linear + 2.0 * self._bend(values))

    def amounts_and_rates(self, values: Floats) -> tuple[Floats, Floats]:
        """Return :meth:`amounts` and :meth:`amount_rates`, which have a part in common."""
        bend = self._bend(values)
        first = self.linear + bend
        return np.asarray(first @ values), np.asarray(first + bend)

    def _bend(self, values: Floats) -> Floats:
        """Return half the derivative (r, k) of the quadratic part."""
        return (self._symmetric @ values).reshape(self.linear.shape)

    @cached_property
    def _symmetric(self) -> Floats:
        """The quadratic map as symmetric matrices, (r k, k): one product is faster than r."""
        first, second = np.triu_indices(self.linear.shape[1])
        out = np.zeros((*self.linear.shape, self.linear.shape[1]))
        out[:, first, second] += 0.5 * self.quadratic
        out[:, second, first] += 0.5 * self.quadratic
        return out.reshape(-1, out.shape[2])


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
    rows = [sp.csr_array(features(values, pairs))]
    rights = [amounts]
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
    shape = count, size = len(values), len(values) + len(first)
    columns = np.arange(count, size)
    rows = np.concatenate([np.arange(count), first, second])
    places = np.concatenate([np.arange(count), columns, columns])
    data = np.concatenate([np.ones(count), values[second], values[first]])
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
