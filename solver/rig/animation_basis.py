"""Few shapes that span many skins, so that a frame of an animation is a few weights.

A truncated singular value decomposition has the least mean error; what shows is the greatest. So
vertices that are furthest off are weighed up until the greatest error is small enough (iteratively
reweighted least squares), and where that does not help a few shapes more are taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solver.normals import vertex_normals
from solver.surface import Floats, Ints, Surface

Singles = NDArray[np.float32]

MOST_SHAPES = 64
FIRST_SHAPES = 6
MORE_SHAPES = 1.4
"""So many times as many shapes are tried next."""
REWEIGHTINGS, LAST_REWEIGHTINGS = 2, 8
"""Before there are more shapes, and where there may be no more."""
LEAST_IMPORTANCE = np.float32(1e-3)
"""Of a coordinate, by the mean: all of them count."""
MOST_SAMPLES = 400
"""The shapes are those of so many frames at most, evenly taken; all frames are made of them."""
STILL_MM = 1e-3
"""What moves less is left out, a vertex or a shape."""
BLOCK = 64
"""Frames that are looked at together."""
SMALLEST_SHAPE = 1e-9
"""Square of a shape, by the greatest, that counts as none."""
RIDGE = 1e-6
"""Part of the greatest variance of weights that keeps normals from growing where shapes hide."""


@dataclass(frozen=True)
class Basis:
    """Skins are about neutral + weights @ shapes at the vertices ``moving`` (k,); others are still.

    ``shapes`` (s, k, 3) are in mm, ``weights`` (f, s) lie between 0 and 1 and reach both, but for
    the first one's, which is 1 throughout: that shape is what all others count from.
    """

    moving: Ints
    shapes: Singles
    weights: Floats


def spanning(neutral: Surface, skins: Singles, within_mm: float) -> Basis:
    """Return a basis of ``skins`` (f, v, 3), mm, with no vertex further off than ``within_mm``.

    Unless there are :data:`MOST_SHAPES`, or frames that were not sampled ask for more.
    """
    moving = _moving(neutral, skins)
    chosen = np.unique(np.linspace(0, len(skins) - 1, MOST_SAMPLES).round().astype(int))
    samples = _motion(neutral, skins[chosen], moving)
    directions, importance = _directions(samples, within_mm)
    towards = (directions * importance).astype(np.float64)
    # skins of fewer dimensions leave shapes of nothing
    solve = np.linalg.pinv(towards @ directions.T, rcond=SMALLEST_SHAPE, hermitian=True)
    amounts = np.vstack(
        [_motion(neutral, block, moving) @ towards.T @ solve for block in _blocks(skins)]
    )
    least, most = amounts.min(axis=0), amounts.max(axis=0)
    longest = np.linalg.norm(directions.reshape(len(directions), -1, 3), axis=2).max(axis=1)
    used = (most - least) * longest > STILL_MM
    span = (most - least)[used]
    start = least @ directions
    shapes = np.vstack([start[None], span[:, None] * directions[used]])
    weights = np.hstack([np.ones((len(amounts), 1)), (amounts - least)[:, used] / span])
    return Basis(moving, shapes.reshape(-1, len(moving), 3).astype(np.float32), weights)


def normal_shapes(neutral: Surface, skins: Singles, basis: Basis) -> Singles:
    """Return changes of the moving vertices' normals (s, k, 3), whose blend is the skins' normals.

    They are the least squares over frames of the animation: normals are not linear in the motion.
    """
    chosen = np.unique(np.linspace(0, len(skins) - 1, MOST_SAMPLES).round().astype(int))
    at_rest = vertex_normals(neutral)[basis.moving]
    weights = basis.weights[chosen]
    right = np.zeros((weights.shape[1], at_rest.size))
    for row, frame in zip(weights, chosen, strict=True):
        surface = neutral.moved(skins[frame].astype(np.float64))
        right += row[:, None] * (vertex_normals(surface)[basis.moving] - at_rest).ravel()
    gram = weights.T @ weights
    gram[np.diag_indices_from(gram)] += RIDGE * gram.max()
    changes = np.linalg.solve(gram, right)
    return changes.reshape(-1, *at_rest.shape).astype(np.float32)


def greatest_error(neutral: Surface, skins: Singles, basis: Basis) -> float:
    """Return how far a vertex of ``skins`` (f, v, 3) is off what the basis makes of them, mm."""
    still = np.setdiff1d(np.arange(skins.shape[1]), basis.moving)
    shapes = basis.shapes.reshape(len(basis.shapes), -1)
    worst = 0.0
    for number, block in enumerate(_blocks(skins)):
        rows = basis.weights[number * BLOCK : number * BLOCK + len(block)].astype(np.float32)
        off = _motion(neutral, block, basis.moving) - rows @ shapes
        others = _motion(neutral, block, still)
        worst = max(worst, *(_longest(each) for each in (off, others)))
    return worst


def _directions(samples: Singles, within_mm: float) -> tuple[Singles, Singles]:
    """Return shapes (s, 3 k) that make all ``samples`` (f, 3 k), and how much coordinates count.

    The importance (3 k,) is what the shapes are the best by.
    """
    importance = np.ones(samples.shape[1], np.float32)
    most = min(MOST_SHAPES, len(samples))
    count, tries = min(FIRST_SHAPES, most), 0
    while True:
        gram = ((samples * importance) @ samples.T).astype(np.float64)
        along = np.linalg.eigh(gram)[1][:, -count:].astype(np.float32)
        directions = along.T @ samples
        off = (samples - along @ directions).reshape(len(samples), -1, 3)
        errors = np.linalg.norm(off, axis=2).max(axis=0)
        tries += 1
        if errors.max() <= within_mm or (count == most and tries == LAST_REWEIGHTINGS):
            return directions, importance
        if tries >= REWEIGHTINGS and count < most:
            count, tries = min(int(MORE_SHAPES * count), most), 0
        importance = importance * np.repeat(errors / errors.mean(), 3)
        importance = np.maximum(importance / importance.mean(), LEAST_IMPORTANCE)


def _moving(neutral: Surface, skins: Singles) -> Ints:
    """Return the vertices that leave their place; one, if all are still."""
    vertices = neutral.vertices.astype(np.float32)
    most = np.zeros(len(vertices), np.float32)
    for block in _blocks(skins):
        most = np.maximum(most, np.abs(block - vertices).max(axis=(0, 2)))
    moving = np.flatnonzero(most > STILL_MM)
    return moving if len(moving) else np.zeros(1, np.int64)


def _motion(neutral: Surface, skins: Singles, vertices: Ints) -> Singles:
    """Return how far ``vertices`` (k,) are from the neutral in each skin, (f, 3 k)."""
    at_rest = neutral.vertices[vertices].astype(np.float32)
    return np.asarray((skins[:, vertices] - at_rest).reshape(len(skins), -1))


def _blocks(skins: Singles) -> Iterator[Singles]:
    return (skins[first : first + BLOCK] for first in range(0, len(skins), BLOCK))


def _longest(motion: Singles) -> float:
    return float(np.linalg.norm(motion.reshape(len(motion), -1, 3), axis=2).max(initial=0.0))
