"""Fibre directions of every muscle in every tetrahedron, by Laplace fields between attachments.

Fibres run along the gradient of a potential u with div(sigma grad u) = 0 that grows from the origin
to the insertion; sigma is the muscle's share of a tet, so that no fibre leaves the muscle sideways
(the preferred directions of Ichim, Kadlecek, Kavan and Pauly, "Phace", 2017; Laplace-Dirichlet
fibres are due to Bayer, Blake, Plank and Trayanova, 2012). Around a ring u has no ends: there it is
an angle that grows by 2 pi on the way round.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.anatomy.template import Muscle
from solver.surface import Floats, Ints
from solver.triangles import area_normals

STRAIGHT_END, BENT_END = 0.15, 0.05
"""Part of a muscle's length at each end where the potential is given. Less takes the top of a dome,
such as frontalis has, for the whole end, and fibres fan out from it; more takes the side of a bent
muscle, such as half a ring, for its end."""
BENT = 0.16
"""A muscle is bent if its middle lies off its axis by more than this part of its length."""
REACH_MM = 5.0
"""Muscle further than this from its candidates is outside the flesh."""
LEAST_SHARE = 0.01
"""Conductivity of the flesh around a muscle, for its candidates beside it."""
PULL = 1e-6
"""Weight of the potential's first guess, for pieces of flesh that no end touches."""


def fibre_directions(
    vertices: Floats, tets: Ints, weights: sp.csr_array, muscles: tuple[Muscle, ...]
) -> Floats:
    """Return unit directions (nnz, 3), one for each stored entry of S, zero in column 0.

    Parameters
    ----------
    vertices, tets
        Rest vertices (p, 3) in mm and tetrahedra (n, 4) of positive volume.
    weights
        S (n, m + 1): its entries are the candidates, its values the shares of the muscles.
    muscles
        The m muscles, in the place of ``vertices``. Directions go from origin to insertion, or
        once around a ring.
    """
    entries = weights.tocoo()
    gradients, sizes = _basis(vertices, tets)
    directions = np.zeros((weights.nnz, 3))
    for column, muscle in enumerate(muscles, start=1):
        own = np.flatnonzero(entries.col == column)
        if len(own) == 0:
            continue
        rows = entries.row[own]
        field = _Field(
            vertices, tets[rows], gradients[rows], sizes[rows] * (entries.data[own] + LEAST_SHARE)
        )
        flow = field.around(muscle) if muscle.ring else field.along(muscle)
        length = np.linalg.norm(flow, axis=1)
        found = length > 0
        directions[own[found]] = flow[found] / length[found, None]
        directions[own[~found]] = muscle.fibre
    return directions


def _basis(vertices: Floats, tets: Ints) -> tuple[Floats, Floats]:
    """Return the gradients (n, 4, 3) of the linear basis functions and the volumes (n,)."""
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    others = np.swapaxes(np.linalg.inv(edges), 1, 2)
    gradients = np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)
    return gradients, np.linalg.det(edges) / 6.0


def _bend(muscle: Muscle) -> float:
    """Return how far a muscle's middle lies off the line between its ends, by their distance."""
    corners = muscle.surface.vertices[muscle.surface.faces]
    normals = area_normals(muscle.surface.vertices, muscle.surface.faces)
    area = np.linalg.norm(normals, axis=1)
    off = np.average(corners.mean(axis=1), axis=0, weights=area)
    off = off - (muscle.origin + muscle.insertion) / 2
    off = off - muscle.fibre * (off @ muscle.fibre)
    return float(np.linalg.norm(off) / np.linalg.norm(muscle.insertion - muscle.origin))


class _Field:
    """Potentials on the candidates of one muscle, with the conductivity times volume of each."""

    def __init__(self, vertices: Floats, tets: Ints, gradients: Floats, weight: Floats) -> None:
        numbers, local = np.unique(tets, return_inverse=True)
        self._points = vertices[numbers]
        self._tets = local.reshape(tets.shape)
        self._gradients = gradients
        self._weight = weight
        entries = np.einsum("t,tid,tjd->tij", weight, gradients, gradients)
        pairs = (np.repeat(self._tets, 4, axis=1).ravel(), np.tile(self._tets, 4).ravel())
        count = len(numbers)
        self._matrix = sp.csc_array((entries.ravel(), pairs), shape=(count, count))

    def along(self, muscle: Muscle) -> Floats:
        """Return the gradient (t, 3) of the potential between a muscle's ends."""
        surface = muscle.surface.vertices
        # What of the muscle lies outside the flesh, such as the platysma below the cut, has no say.
        surface = surface[cKDTree(self._points).query(surface)[0] < REACH_MM]
        extent = surface @ muscle.fibre
        low, high = np.quantile(extent, [0.02, 0.98])
        guess = (self._points @ muscle.fibre - low) / (high - low)
        place = (extent[cKDTree(surface).query(self._points)[1]] - low) / (high - low)
        end = BENT_END if _bend(muscle) > BENT else STRAIGHT_END
        given = (place < end) | (place > 1 - end)
        potential = self._solved(np.zeros(len(guess)), guess, given)
        return self._gradient(potential)

    def around(self, muscle: Muscle) -> Floats:
        """Return the harmonic flow (t, 3) around a ring: the angle's gradient, made source-free."""
        surface = muscle.surface.vertices
        centre = (surface.min(axis=0) + surface.max(axis=0)) / 2
        across, up, _ = np.linalg.svd(surface - surface.mean(axis=0), full_matrices=False)[2]
        away = self._points - centre
        angle = np.arctan2(away @ up, away @ across)[self._tets]
        # Within a tet the angle does not jump by 2 pi.
        steps = np.angle(np.exp(1j * (angle - angle[:, :1])))
        turning = np.einsum("ti,tid->td", steps, self._gradients)
        sources = -np.einsum("t,tid,td->ti", self._weight, self._gradients, turning)
        load = np.zeros(len(self._points))
        np.add.at(load, self._tets, sources)
        nothing = np.zeros(len(load))
        correction = self._solved(load, nothing, np.zeros(len(load), dtype=bool))
        return np.asarray(turning + self._gradient(correction))

    def _gradient(self, potential: Floats) -> Floats:
        return np.asarray(np.einsum("ti,tid->td", potential[self._tets], self._gradients))

    def _solved(self, load: Floats, guess: Floats, given: np.ndarray) -> Floats:
        """Return u (p,) with -div(sigma grad u) = ``load`` that is ``guess`` where it is given."""
        free = ~given
        pull = PULL * self._matrix.diagonal().mean() * sp.eye_array(len(guess))
        matrix = (self._matrix + pull).tocsc()
        right = load + pull @ guess - matrix[:, given] @ guess[given]
        solution = guess.copy()
        if free.any():
            solution[free] = splu(matrix[free][:, free]).solve(right[free])
        return solution
