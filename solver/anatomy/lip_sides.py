"""Which lip a place on the skin belongs to: the one whose middle is nearer on the surface.

The way from one lip to the other leads around a corner of the mouth, so that no plane is needed,
which a bent line of the mouth or an overbite would cross.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from solver.surface import Floats, Ints, Surface
from solver.triangles import directed_edges

UPPER, LOWER = 1, -1


def lips_apart(flesh: Surface, landmarks: Mapping[str, int]) -> Ints:
    """Do as :func:`lip_sides` from the edges of the lips at the mid-line.

    From there the ways along both lips to a corner of the mouth are equally long. ``flesh`` has the
    triangles to walk on, ``landmarks`` are name -> vertex.
    """
    upper, lower = (np.array([landmarks[f"stomion_{lip}us"]]) for lip in ("superi", "inferi"))
    return lip_sides(flesh.vertices, flesh.faces, upper, lower)


def lip_sides(skin: Floats, faces: Ints, upper: Ints, lower: Ints) -> Ints:
    """Return for each skin vertex :data:`UPPER` or :data:`LOWER`, 0 where neither is reached.

    Parameters
    ----------
    skin
        (V, 3) vertices in mm.
    faces
        (f, 3) the triangles of the flesh: teeth and eyes are not walked on.
    upper, lower
        Vertices on the middle of each lip.
    """
    edges = directed_edges(faces)
    lengths = np.linalg.norm(skin[edges[:, 0]] - skin[edges[:, 1]], axis=1)
    graph = sp.coo_array((lengths, tuple(edges.T)), shape=(len(skin), len(skin))).tocsr()
    to_upper, to_lower = (
        dijkstra(graph, directed=False, indices=seeds, min_only=True) for seeds in (upper, lower)
    )
    return np.asarray(UPPER * (to_upper < to_lower) + LOWER * (to_lower < to_upper))
