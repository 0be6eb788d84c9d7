"""Few shapes that span skins which come one by one, so that nothing waits for the last of them.

A skin that the shapes so far do not reach adds what is left of it, made orthogonal to them twice,
in double precision: once leaves parts along them that add up from shape to shape, twice is enough
(Giraud, Langou and Rozloznik 2005). In the end the shapes are turned so that the first hold most of
the motion, and as many are left as are needed. Turned shapes stay orthonormal, so a skin is no sum
of large shapes that cancel: other programs blend them in single precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from solver.rig.skin_basis import BLOCK, Singles
from solver.surface import Floats, Surface

PASSES = 2  # of Gram and Schmidt's orthogonalisation


@dataclass(frozen=True)
class GrowingOptions:
    """Accuracy and most number of the shapes."""

    # a vertex may be so far off; a file's numbers have the rest of the 0.2 mm that it may be off
    within_mm: float = 0.15
    # part of that up to which a skin asks for no shape: the rest is for those left out in the end
    unreached: float = 0.5
    # Takes ask for less than a hundred, and none for more than it has frames. So many of 27,000
    # vertices are 0.3 GB in double precision.
    most_shapes: int = 512
    first_shapes: int = 32  # there is room for; doubled where that is full


SEQUENCE_BASIS = GrowingOptions()


class GrowingBasis:
    """Takes skins (v, 3), mm, and spans their motions from the ``neutral``."""

    def __init__(self, neutral: Surface, options: GrowingOptions = SEQUENCE_BASIS) -> None:
        self._neutral, self._options = neutral.vertices, options
        self._room = np.empty((options.first_shapes, neutral.vertices.size))
        self._count = 0
        self._weights: list[Floats] = []
        self._off: list[float] = []  # mm that each skin is off its sum of shapes

    def add(self, skin: Floats) -> None:
        """Take a skin; a shape more if those so far do not reach it."""
        options, shapes = self._options, self._room[: self._count]
        rest = (skin - self._neutral).ravel()
        weights = np.zeros(self._count)
        for _ in range(PASSES):
            along = shapes @ rest
            rest = rest - along @ shapes
            weights += along
        off = float(_lengths(rest).max())
        if off > options.unreached * options.within_mm and self._count < options.most_shapes:
            length = np.linalg.norm(rest)
            self._append(rest / length)
            weights, off = np.append(weights, length), 0.0
        self._weights.append(weights)
        self._off.append(off)

    def turned(self) -> tuple[Singles, Floats]:
        """Return orthonormal shapes (s, 3 v), those of most motion first, and weights (f, s).

        There are as few as hold all skins within the options' distance, if there may be so many.
        """
        table = np.zeros((len(self._weights), self._count))
        for row, values in zip(table, self._weights, strict=True):
            row[: len(values)] = values
        turn = scipy.linalg.eigh(table.T @ table)[1][:, ::-1] if self._count else np.eye(0)
        weights = table @ turn
        # a vector's sign is left open: the greatest weight of each is above zero
        upward = np.where(weights.max(axis=0) < -weights.min(axis=0), -1.0, 1.0)
        turn, weights = turn * upward, weights * upward
        shapes = (turn.T @ self._room[: self._count]).astype(np.float32)
        few, many = 0, self._count
        while few < many:
            middle = (few + many) // 2
            if self._is_enough(shapes[middle:], weights[:, middle:]):
                many = middle
            else:
                few = middle + 1
        return shapes[:many], weights[:, :many]

    def _is_enough(self, left_out: Singles, weights: Floats) -> bool:
        """Return whether skins are within the distance without shapes that are ``left_out``."""
        singles, allowed = weights.astype(np.float32), self._options.within_mm - np.array(self._off)
        return all(
            (_lengths(singles[rows] @ left_out).max(axis=1) <= allowed[rows]).all()
            for rows in _blocks(len(singles))
        )

    def _append(self, shape: Floats) -> None:
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.empty_like(self._room)])
        self._room[self._count] = shape
        self._count += 1


def _lengths(motion: np.ndarray) -> np.ndarray:
    """Return the lengths (..., v) of the vectors of motions (..., 3 v)."""
    return np.asarray(np.linalg.norm(motion.reshape(*motion.shape[:-1], -1, 3), axis=-1))


def _blocks(frames: int) -> Iterator[slice]:
    return (slice(first, first + BLOCK) for first in range(0, frames, BLOCK))
