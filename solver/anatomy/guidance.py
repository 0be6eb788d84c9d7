"""What pulls a mesh of flesh: the skin it carries, the bones it lies on, and its place."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.anatomy.relaxation import Guides
from solver.anatomy.template import Template
from solver.surface import Floats, Ints

FACE_PULL = 20.0
SKIN_PULL = 4.0
"""Of a skin vertex, on the face and elsewhere; 1/mm^2."""
BONE_PULL = 10.0
"""Of a vertex on a bone or cut plane."""
STAY = 0.1
"""Of every vertex to where it starts, so that nothing drifts that is not pulled."""


def guidance(
    head: Template,
    skin: Floats,
    embedded: Ints,
    surface_rows: sp.csr_array,
    held: Ints,
    held_at: Floats,
    start: Floats,
) -> Guides:
    """Return the springs of a mesh.

    Parameters
    ----------
    head
        Says which skin vertices are the face's.
    skin
        (n, 3) positions the skin should have.
    embedded, surface_rows
        (e,) skin vertices that follow the mesh, and the (e, p) rows of their surface points.
    held, held_at
        (h,) vertices on bones and cut planes, and where they belong, (h, 3).
    start
        (p, 3) positions of all vertices.
    """
    count = len(start)
    pull = np.where(np.isin(embedded, head.face_vertices), FACE_PULL, SKIN_PULL)
    return Guides.joined(
        [
            Guides(surface_rows, skin[embedded], pull),
            Guides.of_vertices(held, held_at, BONE_PULL, count),
            Guides.of_vertices(np.arange(count), start, STAY, count),
        ]
    )
