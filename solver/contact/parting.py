"""Lips that lie in each other, moved apart: what contact of a scan with closed lips begins with."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import rows_of
from solver.contact.mouth import Mouth
from solver.contact.overlap import between_lips
from solver.surface import Floats

GAP_MM = 0.02
"""Lips are moved so far beyond the place where they meet."""
ROUNDS = 20
"""A few are enough, as vertices pull on one another."""


def parted(mouth: Mouth, points: Floats) -> Floats:
    """Return the points (m, 3) of a mouth with both lips giving way by half of where they cross."""
    count = len(points)
    for _ in range(ROUNDS):
        found = between_lips(mouth, points)
        if not len(found.ids):
            break
        vertex = rows_of(found.ids[:, None], np.ones((len(found.ids), 1)), count)
        nearest = rows_of(found.corners, found.shares, count)
        half = 0.5 * (found.depth + GAP_MM)[:, None] * found.out
        asked = np.asarray(sp.csr_array(vertex + nearest).sum(axis=0))
        moves = (vertex - nearest).T @ half
        points = points + moves / np.maximum(asked, 1.0)[:, None]
    return points
