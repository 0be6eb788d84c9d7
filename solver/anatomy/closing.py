"""From the parted pose, in which the flesh is meshed, back to the neutral pose."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.optimize import minimize
from scipy.sparse.linalg import splu

from solver.anatomy.tetrahedra import volumes
from solver.errors import SolveError
from solver.surface import Floats, Ints

LEAST_SHRINK = 0.05
"""Every tetrahedron keeps at least this part of its volume in the parted pose."""
ROUNDS = 6
RINGS = 3
SMOOTHING_VOLUME = 0.02


def harmonic_displacement(vertices: Floats, tets: Ints, known: Ints, values: Floats) -> Floats:
    """Return the displacement (p, 3) that is ``values`` (k, 3) at ``known`` (k,) and harmonic.

    Linear finite elements; the vertices (p, 3) give the metric.
    """
    laplacian = sp.csc_array(igl.cotmatrix(vertices, tets))
    displacement = np.zeros_like(vertices)
    displacement[known] = values
    free = np.setdiff1d(np.arange(len(vertices)), known)
    inner = sp.csc_matrix(-laplacian[free][:, free])
    right = laplacian[free][:, known] @ values
    displacement[free] = splu(inner, permc_spec="MMD_AT_PLUS_A").solve(np.ascontiguousarray(right))
    return displacement


def untangled(rest: Floats, moved: Floats, tets: Ints, held: Ints) -> Floats:
    """Return ``moved`` (p, 3) changed as little as needed so that no tetrahedron is inverted.

    ``rest`` (p, 3) is a valid pose of the same tetrahedra and ``held`` vertices stay. Around
    tetrahedra that are inverted or nearly flat, the foldover-free energy of Garanzha, Kaporin,
    Kudryavtseva, Protais, Ray and Sokolov (2021) is minimised: the mean-ratio distortion with
    the determinant regularised so that it is finite, and pushed off, below zero.

    Raises
    ------
    SolveError
        ``mesh.inverted`` if that does not succeed.
    """
    result = moved.copy()
    for number in range(ROUNDS):
        bad = _shrink(rest, result, tets) < LEAST_SHRINK
        if not bad.any():
            return result
        result = _relaxed_around(rest, result, tets, held, bad, RINGS + number)
    bad = _shrink(rest, result, tets) <= 0
    if bad.any():
        raise SolveError(
            "mesh.inverted",
            f"{int(bad.sum())} tetrahedra stay inverted when the lips are closed",
            tets=np.flatnonzero(bad)[:10].tolist(),
        )
    return result


def _shrink(rest: Floats, moved: Floats, tets: Ints) -> Floats:
    return volumes(moved, tets) / volumes(rest, tets)


def _relaxed_around(
    rest: Floats, moved: Floats, tets: Ints, held: Ints, bad: np.ndarray, rings: int
) -> Floats:
    near = np.zeros(len(rest), dtype=bool)
    near[tets[bad]] = True
    for _ in range(rings - 1):
        near[tets[near[tets].any(axis=1)]] = True
    near[held] = False
    local = tets[near[tets].any(axis=1)]
    free = np.flatnonzero(near)
    inverse: Floats = np.asarray(np.linalg.inv(_edges(rest, local)), dtype=np.float64)
    weight = volumes(rest, local)
    weight = weight / weight.mean()
    numbers = np.full(len(rest), -1)
    numbers[free] = np.arange(len(free))
    start = moved[free]

    def energy(flat: Floats) -> tuple[float, Floats]:
        pose = moved.copy()
        pose[free] = flat.reshape(-1, 3)
        value, gradient = _distortion(pose, local, inverse, weight)
        away = pose[free] - start
        stay = 1e-2
        total = value + stay * float(np.sum(away**2))
        return total, (gradient[free] + 2 * stay * away).ravel()

    solution = minimize(
        energy, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 300}
    )
    result = moved.copy()
    result[free] = solution.x.reshape(-1, 3)
    return result


def _edges(vertices: Floats, tets: Ints) -> Floats:
    """Return (t, 3, 3) matrices whose columns are the edges from the first vertex."""
    corners = vertices[tets]
    return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)


def _distortion(pose: Floats, tets: Ints, inverse: Floats, weight: Floats) -> tuple[float, Floats]:
    """Return sum of |F|^2 / chi(det F)^(2/3) and its gradient (p, 3)."""
    f = _edges(pose, tets) @ inverse
    det = np.linalg.det(f)
    root = np.sqrt(SMOOTHING_VOLUME**2 + det**2)
    chi = (det + root) / 2
    chi_slope = (1 + det / root) / 2
    square = np.sum(f**2, axis=(1, 2))
    power = np.maximum(chi, 1e-12) ** (-2.0 / 3.0)
    cofactor = np.stack(
        [
            np.cross(f[:, 1], f[:, 2]),
            np.cross(f[:, 2], f[:, 0]),
            np.cross(f[:, 0], f[:, 1]),
        ],
        axis=1,
    )
    by_f = 2 * power[:, None, None] * f
    by_f -= (2.0 / 3.0 * square * power / chi * chi_slope)[:, None, None] * cofactor
    by_edges = weight[:, None, None] * by_f @ np.swapaxes(inverse, 1, 2)
    gradient = np.zeros_like(pose)
    for k in range(3):
        np.add.at(gradient, tets[:, k + 1], by_edges[:, :, k])
    np.add.at(gradient, tets[:, 0], -by_edges.sum(axis=2))
    return float(np.sum(weight * square * power)), gradient
