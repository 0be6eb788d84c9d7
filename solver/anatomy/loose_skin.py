"""Skin beyond the flesh, as of ears, scalp and neck: it follows the skin that lies on flesh.

    min_d  1/2 sum_ij (d_i - d_j)^2 + 1/2 sum_i A_i |d_i|^2 / l^2

over the edges ij of the skin and the vertices i, of displacements d; those on flesh are given. So
what the chin does to the neck fades over the length l, and no edge opens where the flesh ends.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from solver.model import SubjectModel
from solver.surface import Floats
from solver.triangles import adjacency, vertex_areas

FADE_MM = 60.0
"""The length l: a mouth opened wide takes the neck along by centimetres."""


class LooseSkin:
    """The vertices ``ids`` (k,) of a model's skin that hang on flesh by edges, but lie on none."""

    def __init__(self, model: SubjectModel) -> None:
        skin, faces = model.skin.vertices, model.skin.faces
        edges = adjacency(faces, len(skin))
        _, part = connected_components(edges, directed=False)
        hangs = np.isin(part, part[model.embedded])
        hangs[model.embedded] = hangs[model.attached_mandible] = False
        self.ids = np.flatnonzero(hangs)
        own = np.asarray(edges.sum(axis=1)) + vertex_areas(skin, faces) / FADE_MM**2
        system = sp.csr_array(sp.diags_array(own) - edges)[self.ids]
        self._pull = -system[:, model.embedded]
        self._factor = splu(sp.csc_array(system[:, self.ids])) if len(self.ids) else None

    def follow(self, moved: Floats) -> Floats:
        """Return the displacements (k, 3) where the embedded vertices are displaced by ``moved``.

        Lengths in mm; ``moved`` (e, 3) is by ``model.embedded``.
        """
        if self._factor is None:
            return np.empty((0, 3))
        return np.asarray(self._factor.solve(np.asarray(self._pull @ moved)))
