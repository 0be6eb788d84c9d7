"""From the parted pose, in which the flesh is meshed, back to the neutral pose."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from solver.anatomy.embedding import barycentric
from solver.anatomy.template import Template
from solver.surface import Floats, Ints, Surface


def closed(head: Template, vertices: Floats, tets: Ints, outside: Ints, held: Ints) -> Floats:
    """Return the flesh's vertices (p, 3), meshed with parted lips, with the lips closed.

    Vertices of the ``outside`` faces (f, 3) move with the skin they lie on, ``held`` ones stay
    and the others follow harmonically; tets between the lips may come out inverted.
    """
    skin_side = np.setdiff1d(outside, held)
    skin = Surface(head.parted.vertices, head.skin.faces[head.flesh_faces])
    face, shares, _ = barycentric(vertices[skin_side], skin)
    displacement = np.einsum("nk,nkd->nd", shares, -head.parting[skin.faces[face]])
    known = np.concatenate([skin_side, held])
    values = np.vstack([displacement, np.zeros((len(held), 3))])
    return vertices + harmonic_displacement(vertices, tets, known, values)


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
