"""The symmetric option: muscles of the left and right change alike, as far as the tets allow.

A tet mesh is not its own mirror image, and neither is a person. So nothing is forced: the prior
(w_m/2) sum (ds_ij - ds_i'j')^2 asks the *changes* ds of S from its start, which has the mesh's own
asymmetry, to be alike at the tet i' nearest to the mirrored centroid of tet i and the muscle j' of
the other side. The mirror is the jaw frame's middle plane.
"""

from __future__ import annotations

import re

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from solver.errors import InputError
from solver.model import SubjectModel
from solver.surface import Floats, Ints

OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}

REACH_MM = 4.0
"""A tet further than this from its mirrored place has no counterpart."""


def mirror_structure(model: SubjectModel, w_m: float) -> sp.csr_array:
    """Return L (k, nnz), so that 1/2 |L ds|^2 is the prior; entries without counterpart are free.

    Raises :class:`InputError` (``model.no_sides``) if no muscle's name tells its side.
    """
    S = model.weights
    numbers = sp.csr_array((np.arange(1, S.nnz + 1), S.indices, S.indptr), shape=S.shape)
    tets = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
    tet, muscle = mirrored_tets(model)[tets], mirrored_muscles(model.muscle_names)[S.indices]
    found = np.asarray(numbers[np.maximum(tet, 0), muscle]).ravel() - 1
    own = np.arange(S.nnz)
    paired = np.flatnonzero((tet >= 0) & (found >= 0) & (found != own))
    root = np.full(len(paired), np.sqrt(w_m))
    rows = np.arange(len(paired))
    return sp.csr_array(
        (
            np.concatenate([root, -root]),
            (np.concatenate([rows, rows]), np.concatenate([paired, found[paired]])),
        ),
        shape=(len(paired), S.nnz),
    )


def mirrored_muscles(names: tuple[str, ...]) -> Ints:
    """Return for every column of S the column of the other side, for those in the middle their own.

    The sides are the words left, right, l and r of a name.
    """
    words = [tuple(re.split(r"[\s_]+", name.lower())) for name in names]
    columns = {name: number for number, name in enumerate(words, start=1)}
    swapped = [tuple(OTHER_SIDE.get(word, word) for word in name) for name in words]
    if swapped == words:
        raise InputError("model.no_sides", "no muscle's name says left or right: nothing mirrors")
    others = [columns.get(name, number) for number, name in enumerate(swapped, start=1)]
    return np.array([0, *others])


def mirrored_tets(model: SubjectModel) -> Ints:
    """Return for every tet the nearest to its mirror image, -1 if none is near."""
    centres = model.rest[model.tets].mean(axis=1)
    distance, nearest = cKDTree(centres).query(_mirrored(model, centres))
    return np.where(distance <= REACH_MM, nearest, -1)


def _mirrored(model: SubjectModel, points: Floats) -> Floats:
    across = model.jaw.axes[0]
    return np.asarray(points - 2.0 * np.outer((points - model.jaw.origin) @ across, across))
