"""Fields at the texels of a skin, smoothed over it and over seams.

    min over u  sum_i w_i |u_i - f_i|^2  +  l^4 |Laplacian u|^2  +  m l^2 |grad u|^2

w_i is the area that is seen at a vertex. Waves of the length 2 pi l are halved, longer ones kept,
and u goes on smoothly where nothing is seen.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.mechanics.linear import Rslab
from solver.registration.nonrigid import laplacian
from solver.registration.texels import Texels
from solver.surface import Floats, Surface, own_numbers

MEMBRANE = 0.02  # m
UNSEEN = 1e-5  # share of its area with which a vertex counts that is not seen


class SmoothFields:
    """Smooths fields that are known at ``texels`` (t) with weights (t,); ``length`` is l in mm."""

    def __init__(self, texels: Texels, weights: Floats, length: float) -> None:
        skin = texels.skin
        count = len(texels.rows)
        faces = np.unique(texels.faces)
        vertices, own = own_numbers(skin.faces[faces])
        membrane, area = laplacian(Surface(skin.vertices[vertices], own))
        corners = own[np.searchsorted(faces, texels.faces)]
        shares = np.clip(texels.shares, 0.0, 1.0)
        rows = np.repeat(np.arange(count), 3)
        shape = count, len(vertices)
        self._take = sp.csr_array((shares.ravel(), (rows, corners.ravel())), shape=shape)
        self._seen = weights * texels.areas()
        self._least = UNSEEN * area
        bending = membrane @ sp.diags_array(1 / area) @ membrane
        stiffness = sp.csr_array(length**4 * bending + MEMBRANE * length**2 * membrane)
        stiffness.sort_indices()
        entries = stiffness.tocoo()
        self._stiffness = stiffness
        self._diagonal = entries.row == entries.col
        self._solver = Rslab(stiffness)
        self.weigh(np.ones(count))

    def weigh(self, shares: Floats) -> None:
        """Let texels count by these ``shares`` (t,) of their weights from now on."""
        self._weights = shares * self._seen
        data = self._stiffness.data.copy()
        data[self._diagonal] += self._take.T @ self._weights + self._least
        self._factor = self._solver.factor(data)

    def __call__(self, values: Floats) -> Floats:
        """Return the smooth values (t, k) of ``values`` (t, k)."""
        sums = self._take.T @ (self._weights[:, None] * values)
        return np.asarray(self._take @ self._factor.solve(sums))
