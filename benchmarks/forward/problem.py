"""A block of flesh with held vertices and activations, and its energy by NumPy alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from solver.mechanics.flesh import IDENTITY, shape_gradients
from solver.surface import Floats, Ints

EDGE_MM = 2.5
KAPPA = 3.0
FIBRE = np.array([2.0, 1.0, 0.5]) / np.linalg.norm([2.0, 1.0, 0.5])
CONTRACTION = 0.7
BEND_RAD = 0.8

FIVE_TETS = np.array([[0, 3, 5, 6], [0, 1, 3, 5], [0, 2, 3, 6], [0, 4, 5, 6], [3, 5, 6, 7]])
"""A cube's tets; its corners are numbered by their three binary digits."""


@dataclass(frozen=True)
class Problem:
    """Minimise E(x; a) over the vertices that are not held, from ``start``.

    ``rest`` and ``start`` are (p, 3) in mm, ``tets`` (n, 4), ``held`` vertex numbers, ``a`` (n, 6)
    activations in the order of :data:`solver.mechanics.flesh.IDENTITY`.
    """

    rest: Floats
    tets: Ints
    held: Ints
    start: Floats
    a: Floats


def active(cells: tuple[int, int, int]) -> Problem:
    """Return a block at rest whose middle, a quarter of the tets, contracts along one direction.

    The contraction keeps the volume (det A = 1) and is oblique to the block and its boundary.
    """
    rest, tets = block(cells)
    middle = np.abs(rest[tets].mean(axis=1) - rest.max(axis=0) / 2.0) < rest.max(axis=0) / 4.0
    across = CONTRACTION**-0.5
    A = across * np.eye(3) + (CONTRACTION - across) * np.outer(FIBRE, FIBRE)
    a = np.tile(IDENTITY, (len(tets), 1))
    a[middle[:, :2].all(axis=1)] = A[np.triu_indices(3)]
    return Problem(rest, tets, _bones(rest), rest, a)


def passive(cells: tuple[int, int, int]) -> Problem:
    """Return a passive block, bent about the y axis: held vertices stay there."""
    rest, tets = block(cells)
    middle = rest[:, 0].max() / 2.0
    radius = 2.0 * middle / BEND_RAD
    angle = (rest[:, 0] - middle) / radius
    height = radius + rest[:, 2]
    bent = [middle + height * np.sin(angle), rest[:, 1], height * np.cos(angle) - radius]
    a = np.tile(IDENTITY, (len(tets), 1))
    return Problem(rest, tets, _bones(rest), np.stack(bent, axis=1), a)


def block(cells: tuple[int, int, int]) -> tuple[Floats, Ints]:
    """Return vertices and tets of a block of cubes, five tets each, mirrored from cube to cube."""
    index = np.array(list(product(*(range(count + 1) for count in cells))))
    number = np.arange(len(index)).reshape([count + 1 for count in cells])
    cube = np.array(list(product(*map(range, cells))))
    corners = np.stack([number[tuple((cube + c).T)] for c in product((0, 1), repeat=3)], axis=1)
    mirrored = (cube.sum(axis=1) % 2 == 1)[:, None, None]
    tets = np.where(mirrored, corners[:, 7 - FIVE_TETS], corners[:, FIVE_TETS]).reshape(-1, 4)
    rest = EDGE_MM * index
    flipped = np.linalg.det(rest[tets[:, 1:]] - rest[tets[:, :1]]) < 0.0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    return rest, tets


def _bones(rest: Floats) -> Ints:
    """Return the vertices on the back but for its middle third: bone left and right of a cheek."""
    middle = rest[:, 0].max() / 2.0
    return np.flatnonzero((rest[:, 2] == 0.0) & (np.abs(rest[:, 0] - middle) > middle / 3.0))


def energy(problem: Problem, x: Floats, *, polar_of_f: bool) -> float:
    """Return E at ``x`` (p, 3), R minimising the term |F - R A|^2 or, ``polar_of_f``, polar(F)."""
    gradients, volumes = shape_gradients(problem.rest, problem.tets)
    F = np.einsum("nvi,nvj->nij", x[problem.tets], gradients)
    A = np.empty((len(F), 3, 3))
    for column, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
        A[:, i, j] = A[:, j, i] = problem.a[:, column]
    U, _, Vt = np.linalg.svd(F if polar_of_f else F @ A)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    shape = ((F - U @ Vt @ A) ** 2).sum(axis=(1, 2))
    volume = (np.linalg.det(F) - np.linalg.det(A)) ** 2
    return float(volumes @ (shape + KAPPA * volume))
