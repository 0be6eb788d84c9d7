"""Smooth maps of space from corresponding points: the kernel |r| with an affine part.

In three dimensions |r| is the kernel of the biharmonic spline (Bookstein 1989; Carr et al. 2001):
among all maps through the given points it bends least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve
from scipy.spatial.distance import cdist

from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Warp:
    """x -> x + sum_k |x - centre_k| w_k + [x 1] A.

    ``centres`` (k, 3); ``coefficients`` (k + 4, 3) are the rows w_k, then A.
    """

    centres: Floats
    coefficients: Floats

    def __call__(self, points: Floats) -> Floats:
        """Return the images (n, 3) of ``points`` (n, 3)."""
        return points + basis(points, self.centres) @ self.coefficients


def basis(points: Floats, centres: Floats) -> Floats:
    """Return the (n, k + 4) values of all kernels and of the affine part at ``points``."""
    affine = np.column_stack([points, np.ones(len(points))])
    return np.hstack([cdist(points, centres), affine])


def interpolate(source: Floats, target: Floats, smoothing: float = 0.0) -> Warp:
    """Return the warp that takes ``source`` (k, 3) to ``target`` (k, 3).

    ``smoothing`` in mm lets it miss the targets for less bending; zero goes through them.
    """
    count = len(source)
    matrix = np.zeros((count + 4, count + 4))
    values = basis(source, source)
    # -|r| is conditionally positive definite, hence the sign of the smoothing term.
    matrix[:count] = values
    matrix[:count, :count] -= smoothing * np.eye(count)
    matrix[count:, :count] = values[:, count:].T
    right = np.zeros((count + 4, 3))
    right[:count] = target - source
    return Warp(source, solve(matrix, right, assume_a="sym"))


def spread(points: Floats, count: int) -> Ints:
    """Return the numbers of ``count`` points far from each other (farthest-point sampling)."""
    chosen = np.zeros(min(count, len(points)), dtype=np.int64)
    distance = np.linalg.norm(points - points[0], axis=1)
    for k in range(1, len(chosen)):
        chosen[k] = int(np.argmax(distance))
        np.minimum(distance, np.linalg.norm(points - points[chosen[k]], axis=1), out=distance)
    return chosen


@dataclass(frozen=True)
class PlaneConstraints:
    """Wanted displacements of points along directions: direction_i . u(point_i) = distance_i.

    ``points`` (n, 3), unit ``directions`` (n, 3), ``distances`` (n,) in mm.
    """

    points: Floats
    directions: Floats
    distances: Floats


def least_bending(centres: Floats, planes: PlaneConstraints, stiffness: float) -> Warp:
    """Return the warp that meets ``planes`` in least squares, with ``stiffness`` x bending energy.

    Three plane constraints along the axes fix a point; one slides on a surface.
    """
    count = len(centres)
    polynomial = np.column_stack([centres, np.ones(count)])
    # Kernel weights orthogonal to affine maps: there the bending energy is positive definite.
    complement = np.linalg.qr(polynomial, mode="complete")[0][:, 4:]
    bending = -complement.T @ cdist(centres, centres) @ complement
    values = basis(planes.points, centres)
    values = np.hstack([values[:, :count] @ complement, values[:, count:]])
    width = values.shape[1]
    rows = np.einsum("nd,nk->ndk", planes.directions, values)
    rows = rows.reshape(len(values), 3 * width)
    root = np.linalg.cholesky(bending + 1e-9 * np.trace(bending) / count * np.eye(count - 4)).T
    regular = np.zeros((3 * (count - 4), 3 * width))
    for axis in range(3):
        block = slice(axis * width, axis * width + count - 4)
        regular[axis * (count - 4) : (axis + 1) * (count - 4), block] = np.sqrt(stiffness) * root
    normal = rows.T @ rows + regular.T @ regular
    right = rows.T @ planes.distances
    normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
    solution = solve(normal, right, assume_a="pos")
    solution = solution.reshape(3, width).T
    coefficients = np.vstack([complement @ solution[: count - 4], solution[count - 4 :]])
    return Warp(centres, coefficients)
