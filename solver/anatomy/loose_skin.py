"""Skin beyond the flesh, of ears, scalp and neck, and lashes: they follow the skin on flesh.

    min_d  1/2 sum_ij (d_i - d_j)^2 + 1/2 sum_i A_i |d_i|^2 / l^2

over the edges ij of the skin and the vertices i, of displacements d; those on flesh are given. So
what the chin does to the neck fades over the length l, and no edge opens where the flesh ends. From
lashes and tear film an edge goes to the skin wherever they touch it.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.drawing.parts import skin_parts
from solver.model import SubjectModel
from solver.surface import Floats
from solver.triangles import adjacency, vertex_areas

FADE_MM = 60.0
"""The length l: a mouth opened wide takes the neck along by centimetres."""
TOUCH_MM = 1.0
"""Lashes hang on skin that is nearer than this."""


class LooseSkin:
    """The vertices ``ids`` (k,) of a model's skin that hang on flesh by edges, but lie on none."""

    def __init__(self, model: SubjectModel) -> None:
        skin, faces = model.skin.vertices, model.skin.faces
        edges = _edges(model)
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


def _edges(model: SubjectModel) -> sp.csr_array:
    """Return the graph (V, V) of the skin's edges, and of those by which lashes hang on it."""
    skin, faces = model.skin.vertices, model.skin.faces
    of_lashes = skin_parts(model.skin).get("lashes", np.empty(0, np.int64))
    lashes = np.unique(faces[of_lashes])
    distance, near = cKDTree(skin[model.embedded]).query(skin[lashes])
    touch = distance < TOUCH_MM
    ends = lashes[touch], model.embedded[near[touch]]
    roots = sp.csr_array((np.ones(len(ends[0])), ends), shape=(len(skin),) * 2)
    return sp.csr_array(adjacency(faces, len(skin)) + roots + roots.T)
