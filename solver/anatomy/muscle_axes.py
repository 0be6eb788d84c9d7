"""The axes of muscles: which way their fibres run, from origin to insertion.

For the muscles of BodyParts3D ``data/bodyparts3d_muscles.csv`` says it, from the attachments in
anatomy texts; a muscle that nobody described runs along its greatest length, away from the skull.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Muscle
from solver.surface import Floats, Surface

END = 0.1
"""Part of a muscle's vertices that are an end."""
MIRROR = np.array([-1.0, 1.0, 1.0])


def bodyparts3d_muscle(name: str, surface: Surface, skull: Floats) -> Muscle:
    """Return a muscle of BodyParts3D with the axis of the table.

    One that is not in the table gets an axis as by :func:`with_axis`.
    """
    words = name.split()
    known = _table().get(" ".join(word for word in words if word not in ("left", "right")))
    if known is None:
        return with_axis(name, surface, skull)
    axis, ring = known
    axis = axis * MIRROR if "right" in words else axis
    origin, insertion = _ends(surface, axis)
    return Muscle(name, surface, axis, origin, insertion, ring)


@cache
def _table() -> dict[str, tuple[Floats, bool]]:
    path = resources.files("solver.anatomy.data").joinpath("bodyparts3d_muscles.csv")
    with path.open() as stream:
        rows = list(csv.DictReader(stream))
    axes = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return {row["muscle"]: (a, row["ring"] == "yes") for row, a in zip(rows, axes, strict=True)}


def with_axis(name: str, surface: Surface, skull: Floats) -> Muscle:
    """Return a muscle whose axis is its longest extent, from the end nearer to ``skull`` (k, 3)."""
    centred = surface.vertices - surface.vertices.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    ends = _ends(surface, axis)
    away = cKDTree(skull).query(ends)[0]
    origin, insertion = ends if away[0] <= away[1] else ends[::-1]
    fibre = (insertion - origin) / np.linalg.norm(insertion - origin)
    return Muscle(name, surface, fibre, origin, insertion)


def _ends(surface: Surface, axis: Floats) -> Floats:
    """Return the centres (2, 3) of the ends of a surface along an axis."""
    along = surface.vertices @ axis
    low, high = np.quantile(along, [END, 1 - END])
    ends = (surface.vertices[along <= low], surface.vertices[along >= high])
    return np.stack([end.mean(axis=0) for end in ends])
