"""Maps that are painted on the skin, and what they say of the flesh under it.

A map (V,) has a value between 0 and 1 for every vertex of the scan topology.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from solver.errors import InputError
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.surface import Floats, Ints, vertex_areas


def into_volume(model: SubjectModel, painted: Floats | None, blur_mm: float = 2.0) -> Floats:
    """Return the share (n,) of each tet in what is painted (V,) on the face; None is all of it.

    u on the tets' vertices minimises the integral of |grad u|^2 over the flesh plus that of
    (u - painted)^2 / ``blur_mm`` over the face's skin: heat that comes from there and leaves
    nowhere. Raises :class:`InputError` (``scene.map``) for a map of another skin or with values
    outside of [0, 1].
    """
    if painted is None:
        return np.ones(len(model.tets))
    _check(model, painted)
    gradients, volumes = shape_gradients(model.rest, model.tets)
    count = len(model.rest)
    entries = np.einsum("t,tid,tjd->tij", volumes, gradients, gradients)
    pairs = (np.repeat(model.tets, 4, axis=1).ravel(), np.tile(model.tets, 4).ravel())
    stiffness = sp.csc_array((entries.ravel(), pairs), shape=(count, count))
    on_face = np.isin(model.embedded, model.face)
    skin = model.embedding[on_face]
    area = vertex_areas(model.skin.vertices, model.skin.faces)[model.embedded[on_face]] / blur_mm
    weighed = skin.T @ sp.diags_array(area)
    system = stiffness + weighed @ skin
    # a trace of stiffness for flesh in no contact with the face, which gets none of it
    system += 1e-9 * system.diagonal().mean() * sp.eye_array(count)
    u = splu(system.tocsc()).solve(weighed @ painted[model.embedded[on_face]])
    return np.asarray(np.clip(u, 0.0, 1.0)[model.tets].mean(axis=1))


def spots(model: SubjectModel, centres: Floats, radius_mm: float) -> Floats:
    """Return a map (V,) of soft round spots around points ``centres`` (k, 3), in mm.

    It is (1 - d^2 / radius^2)^2 at a distance d of the nearest centre.
    """
    away = model.skin.vertices[:, None] - centres[None]
    nearest = np.linalg.norm(away, axis=2).min(axis=1, initial=np.inf)
    return np.asarray(np.maximum(1.0 - (nearest / radius_mm) ** 2, 0.0) ** 2)


def patches(model: SubjectModel, vertices: Ints) -> Floats:
    """Return a map (V,) that is 1 on ``vertices`` (k,) and 0 elsewhere."""
    painted = np.zeros(len(model.skin.vertices))
    painted[vertices] = 1.0
    return painted


def _check(model: SubjectModel, painted: Floats) -> None:
    expected = len(model.skin.vertices)
    if painted.shape != (expected,):
        raise InputError(
            "scene.map",
            f"a map has one value for each of the skin's {expected} vertices, not the shape "
            f"{painted.shape}",
            expected=expected,
            found=list(painted.shape),
        )
    wrong = np.flatnonzero(~((painted >= 0.0) & (painted <= 1.0)))
    if len(wrong):
        raise InputError(
            "scene.map",
            f"a map's values lie between 0 and 1; {len(wrong)} do not, the first is "
            f"{painted[wrong[0]]} at vertex {wrong[0]}",
            vertex=int(wrong[0]),
        )
