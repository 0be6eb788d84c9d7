"""Models that a fit can not use, or not wholly: flesh that is held by nothing, idle muscles."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from solver.errors import InputError
from solver.fitting.face import Face
from solver.fitting.notices import Notice


def check_held(face: Face) -> None:
    """Raise ``model.floating`` if a part of the flesh can move without being deformed.

    A part hangs together by its vertices; it is held if its held vertices do not lie on a line.
    """
    flesh = face.flesh
    tets, points = flesh.tets, flesh.rest
    pairs = np.concatenate([tets[:, [0, k]] for k in (1, 2, 3)])
    graph = sp.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    _, part = connected_components(graph, directed=False)
    for number in np.unique(part[tets[:, 0]]):
        vertices = np.flatnonzero(part == number)
        held = points[vertices[flesh.free_numbers[vertices] < 0]]
        if len(held) >= 3 and np.linalg.matrix_rank(held - held[0], tol=1e-6) >= 2:
            continue
        count = int((part[tets[:, 0]] == number).sum())
        place = np.round(points[vertices].mean(axis=0), 1).tolist()
        raise InputError(
            "model.floating",
            f"{count} tetrahedra around {place} mm are held by no bone (vertex {vertices[0]} is "
            "one of theirs): build the model again",
            vertex=int(vertices[0]),
            tets=count,
        )


def idle_muscles(face: Face, S: sp.csr_array) -> list[Notice]:
    """Return the muscles that have no share of any tet: their activations stay at rest."""
    shares = np.asarray(S.sum(axis=0)).ravel()[1:]
    candidates = np.bincount(S.indices, minlength=S.shape[1])[1:]
    found = []
    for number, name in enumerate(face.model.muscle_names):
        if candidates[number] == 0:
            message = f"{name} has no flesh within reach: it moves nothing and stays at rest"
            found.append(Notice("muscle.no_candidates", message, {"muscle": name}))
        elif shares[number] <= 0.0:
            message = f"{name} has no share of any tetrahedron: it moves nothing and stays at rest"
            found.append(Notice("muscle.no_share", message, {"muscle": name}))
    return found
