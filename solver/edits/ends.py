"""Where a model's flesh ends, though a person's does not: at its cuts, and along the neck."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from solver.model import SubjectModel
from solver.surface import Floats
from solver.triangles import adjacency

FADE_MM = 20.0


def off_the_ends(model: SubjectModel) -> Floats:
    """Return 0 for tets (n,) where the model ends, and 1 from :data:`FADE_MM` on."""
    ends = np.vstack([model.rest[model.cut], _border(model)])
    if not len(ends):
        return np.ones(len(model.tets))
    centres = model.rest[model.tets].mean(axis=1)
    t = np.minimum(cKDTree(ends).query(centres)[0] / FADE_MM, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _border(model: SubjectModel) -> Floats:
    """Return the skin's points (k, 3) that follow the flesh beside some that do not.

    Of their lines that is the one around the whole face; others lie in mouth, nose and eyes.
    """
    follows = np.zeros(len(model.skin.vertices), dtype=bool)
    follows[model.embedded] = True
    count = follows[model.skin.faces].sum(axis=1)
    mixed = model.skin.faces[(count > 0) & (count < 3)]
    _, part = connected_components(adjacency(mixed, len(follows)), directed=False)
    lines = [model.skin.vertices[(part == number) & follows] for number in np.unique(part[mixed])]
    return max(lines, key=lambda line: float(np.ptp(line, axis=0).max()), default=np.zeros((0, 3)))
