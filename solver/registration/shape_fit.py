"""The template's own shapes fitted to a scan: who it is, or which expression.

    min over c, motion of  sum_i w_i (n_i . (x_i(c) - q_i))^2 / s^2  +  c . P c

P is the prior: for a person |c|^2 and lips that stay closed, for an expression a little |c|^2 with
0 <= c <= 1.2.

Closest points q_i are found anew in every round and outliers lose their weight (the shape model's
prior follows Blanz & Vetter 1999; the alternation is that of iterated closest points).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from solver.anatomy.shapes import ShapeBasis
from solver.normals import vertex_normals
from solver.registration.correspondence import Pins, motion_columns, pair, pinned
from solver.registration.scan_surface import ScanSurface
from solver.registration.topology import Topology
from solver.similarity import Similarity, small_motion
from solver.surface import Floats, Surface

REACHES_MM = (12.0, 12.0, 10.0, 10.0, 8.0, 8.0, 6.0, 6.0, *(4.0,) * 6, *(3.0,) * 8, *(2.0,) * 6)
NOISE_SHARE = 0.2
"""Standard deviation s of the offsets, as a share of the reach."""
INDEPENDENT = 0.02
"""Neighbouring offsets go together: so many of them count as one observation."""
PINNED_REACH_MM, PIN_MM = 6.0, 3.0
"""Landmarks count while the reach is at least the first; their standard deviation."""
STRONGEST = 1.2
EXPRESSION_PRIOR = 0.5
CLOSED_MM = 0.15
"""Standard deviation of the gap between closed lips."""


@dataclass(frozen=True)
class Shapes:
    """Displacements (k, n, 3) in mm from ``start`` (n, 3), and the ``prior`` (k, k) on weights.

    With ``bounded`` all weights lie in [0, 1.2].
    """

    start: Floats
    displacements: NDArray[np.floating]
    prior: Floats
    bounded: bool

    def at(self, weights: Floats) -> Floats:
        """Return the vertices (n, 3) with these weights (k,)."""
        return np.asarray(self.start + np.tensordot(weights, self.displacements, 1))


def persons(topology: Topology, basis: ShapeBasis) -> Shapes:
    """Return the identities of a template: independent, of unit variance, the lips closed."""
    one, other = topology.touching.T
    gaps = (basis.identity[:, one] - basis.identity[:, other]).reshape(len(basis.identity), -1)
    prior = np.eye(len(gaps)) + INDEPENDENT / CLOSED_MM**2 * (gaps @ gaps.T)
    return Shapes(topology.template.skin.vertices, basis.identity, np.asarray(prior), bounded=False)


def expressions(neutral: Floats, basis: ShapeBasis) -> Shapes:
    """Return the expressions of a person with this ``neutral`` (n, 3)."""
    prior = EXPRESSION_PRIOR * np.eye(len(basis.expressions))
    return Shapes(neutral, basis.expressions, prior, bounded=True)


@dataclass(frozen=True)
class ShapeFit:
    """The weights (k,), the fitted ``vertices`` (n, 3), and the scan's motion onto them."""

    weights: Floats
    vertices: Floats
    motion: Similarity


def fit_shapes(
    scan: ScanSurface,
    motion: Similarity,
    shapes: Shapes,
    topology: Topology,
    pins: Pins | None = None,
    *,
    sizes: bool,
) -> ShapeFit:
    """Fit weights and motion together; with ``sizes`` the scan's size may change.

    ``pins`` guide the rounds in which the scan's points are still far.
    """
    outer, faces = topology.outer, topology.template.skin.faces
    count = len(shapes.prior)
    weights = np.zeros(count)
    for reach in REACHES_MM:
        model = shapes.at(weights)
        normals = vertex_normals(Surface(model, faces))[outer]
        pairs = pair(scan, motion, model[outer], normals, reach)
        trust = pairs.weights * INDEPENDENT / (NOISE_SHARE * reach) ** 2
        pairs, rows = replace(pairs, weights=trust), outer
        if pins is not None and reach >= PINNED_REACH_MM:
            places, goals = model[pins.vertices], motion(pins.points)
            pairs = pinned(pairs, places, goals, 1 / PIN_MM**2)
            rows = np.concatenate([outer, np.repeat(pins.vertices, 3)])
        basis = np.einsum("knd,nd->nk", shapes.displacements[:, rows], pairs.normals)
        # offset = n . (q - x): the model moves by its weights, the scan by its motion
        columns = np.hstack([-basis, motion_columns(pairs, sizes=sizes)])
        weighted = columns * pairs.weights[:, None]
        normal = weighted.T @ columns
        right = -weighted.T @ (pairs.offset + basis @ weights)
        normal[:count, :count] += shapes.prior
        normal[np.diag_indices_from(normal)] += 1e-9
        solution = _solve(normal, right, count if shapes.bounded else 0)
        weights, step = solution[:count], solution[count:]
        motion = motion.then(small_motion(step[:6], float(step[6]) if sizes else 0.0))
    return ShapeFit(weights, shapes.at(weights), motion)


def _solve(normal: Floats, right: Floats, bounded: int) -> Floats:
    """Minimise x N x / 2 - r x, the first ``bounded`` unknowns within [0, 1.2]."""
    if not bounded:
        return np.asarray(np.linalg.solve(normal, right))
    root = np.linalg.cholesky(normal)
    lower, upper = np.full(len(right), -np.inf), np.full(len(right), np.inf)
    lower[:bounded], upper[:bounded] = 0.0, STRONGEST
    return np.asarray(lsq_linear(root.T, np.linalg.solve(root, right), (lower, upper)).x)
