"""Divide muscles into compartments, which contract on their own: strips or sectors.

A face recruits parts of its broad muscles. A template's table says which they are and how they lie
(:class:`solver.anatomy.template.Compartments`); here every candidate of the whole muscle, an entry
of S, gets the number of one of them. So S divided has the pattern and values of S whole, with more
columns.

Strips lie between level sets of a function u that hardly changes along the fibres f, and grows
across them in the direction d of the cut, d' being d square to the fibres, of unit length:

    min int (f . grad u)^2 + slip |grad u - d'|^2 + pull (u - d . x)^2

in linear elements of the muscle's tets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.anatomy.template import Muscle
from solver.anatomy.tetrahedra import volumes
from solver.mechanics.flesh import shape_gradients
from solver.surface import Floats, Ints, own_numbers, unit_rows


@dataclass(frozen=True)
class CutOptions:
    """Numbers of the functions that muscles are cut by."""

    slip: float = 0.1  # weight of growing across the fibres, by that of not changing along them
    pull: float = 1e-5  # of keeping to the place, 1/mm^2: pieces of a muscle are not connected
    # A muscle is one of the middle if that lies within this part of its width from its mean.
    middle: float = 0.2


CUTTING = CutOptions()


@dataclass(frozen=True)
class DividedMuscles:
    """S of compartments: its columns, (n, m + 1), with their names and those of their wholes."""

    weights: sp.csr_array
    names: tuple[str, ...]
    wholes: tuple[str, ...]


def divide_muscles(
    weights: sp.csr_array, muscles: tuple[Muscle, ...], numbers: Ints
) -> DividedMuscles:
    """Return S with a column for each compartment; ``numbers`` as :func:`number_compartments`."""
    counts = [len(muscle.compartment_names) for muscle in muscles]
    first = np.concatenate([[0], 1 + np.cumsum([0, *counts])[:-1]])
    # within a row the order of entries stays: compartments take their whole's place
    columns = (first[weights.indices] + numbers).astype(weights.indices.dtype)
    names = tuple(name for muscle in muscles for name in muscle.compartment_names)
    wholes = tuple(muscle.name for muscle in muscles for _ in muscle.compartment_names)
    parts = weights.data, columns, weights.indptr
    divided = sp.csr_array(parts, shape=(weights.shape[0], len(names) + 1))
    return DividedMuscles(divided, names, wholes)


def number_compartments(
    vertices: Floats,
    tets: Ints,
    weights: sp.csr_array,
    fibres: Floats,
    muscles: tuple[Muscle, ...],
    middle_x: float,
) -> Ints:
    """Return for every entry (nnz,) of S the number of its compartment within its muscle.

    ``vertices`` (p, 3) in mm and ``tets`` (n, 4) are at rest, ``weights`` (n, m + 1) and ``fibres``
    (nnz, 3) those of the whole ``muscles``; x is ``middle_x`` between the sides. The compartments
    of a muscle have equal volumes, up to a tet; one is left out where the muscle has fewer tets
    than compartments. Candidates that the muscle does not fill go with the nearest that it does.
    """
    entries, sizes = weights.tocoo(), volumes(vertices, tets)
    centres = vertices[tets].mean(axis=1)
    numbers = np.zeros(weights.nnz, dtype=np.int64)
    for column, muscle in enumerate(muscles, start=1):
        every = np.flatnonzero(entries.col == column)
        own = every[entries.data[every] > 0.0]
        if muscle.compartments is None or not len(own):
            continue
        rows = entries.row[own]
        places = centres[rows] - [middle_x, 0.0, 0.0]
        cut, names = muscle.compartments.cut, muscle.compartments.names
        if cut == "sectors":
            order = _around(places) if muscle.ring else places @ muscle.fibre
        else:
            direction = _direction(cut, places)
            order = _across(vertices, tets[rows], fibres[own], direction)
        part = _equal_parts(order, sizes[rows] * entries.data[own], len(names))
        numbers[every] = part[cKDTree(centres[rows]).query(centres[entries.row[every]])[1]]
    return numbers


def fibre_laplacian(
    gradients: Floats, sizes: Floats, corners: Ints, fibres: Floats, slip: float
) -> sp.csc_array:
    """Return K (p, p) of u . K u = int (f . grad u)^2 + slip |grad u|^2, for u at p vertices.

    ``gradients`` (k, 4, 3) and ``sizes`` (k,) are those of the tets ``corners`` (k, 4).
    """
    along = np.einsum("evi,ei->ev", gradients, fibres)
    local = along[:, :, None] * along[:, None, :]
    local += slip * gradients @ gradients.transpose(0, 2, 1)
    pairs = np.repeat(corners, 4, axis=1).ravel(), np.tile(corners, 4).ravel()
    return sp.csc_array(((sizes[:, None, None] * local).ravel(), pairs))


def _across(vertices: Floats, tets: Ints, fibres: Floats, direction: Floats) -> Floats:
    """Return u (k,) in tets (k, 4) of a muscle with unit ``fibres`` (k, 3), in mm."""
    gradients, sizes = shape_gradients(vertices, tets)
    used, corners = own_numbers(tets)
    K = fibre_laplacian(gradients, sizes, corners, fibres, CUTTING.slip)
    wanted = unit_rows(direction - (fibres @ direction)[:, None] * fibres)
    load = CUTTING.slip * sizes[:, None] * np.einsum("evi,ei->ev", gradients, wanted)
    pull = CUTTING.pull * np.bincount(corners.ravel(), np.repeat(sizes / 4.0, 4), len(used))
    place = vertices[used] @ direction
    right = pull * place + np.bincount(corners.ravel(), load.ravel(), len(used))
    u = splu((K + sp.diags_array(pull)).tocsc()).solve(right)
    return np.asarray(u[corners].mean(axis=1))


def _direction(cut: str, places: Floats) -> Floats:
    """Return the direction (3,) of a cut for a muscle with ``places`` (k, 3) from the middle."""
    length = _outward(places) if cut == "lateral" else 1.0
    return np.asarray(length * np.eye(3)[("lateral", "superior", "anterior").index(cut)])


def _outward(places: Floats) -> float:
    """Return the sign of x that leads away from the middle; to the left for what lies in it."""
    x = places[:, 0]
    return -1.0 if x.mean() < -CUTTING.middle * np.ptp(x) else 1.0


def _around(places: Floats) -> Floats:
    """Return the angles (k,), in [0, 2 pi), of a ring's places (k, 3) from its top outwards."""
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    axis = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][2]
    up = np.array([0.0, 1.0, 0.0])
    up -= axis * (axis @ up)
    side = np.cross(up, axis)
    side *= _outward(places) * np.sign(side[0])
    return np.asarray(np.arctan2((places - centre) @ side, (places - centre) @ up) % (2.0 * np.pi))


def _equal_parts(values: Floats, sizes: Floats, count: int) -> Ints:
    """Return which of ``count`` parts, of equal sums of sizes (k,), each of the values is in."""
    order = np.argsort(values, kind="stable")
    before = np.cumsum(sizes[order]) - sizes[order] / 2
    parts = np.empty(len(values), dtype=np.int64)
    parts[order] = np.minimum(count * before / sizes.sum(), count - 1).astype(np.int64)
    return parts
