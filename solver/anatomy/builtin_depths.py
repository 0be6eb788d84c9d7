"""Soft-tissue depths: how far the bone lies under the skin, from published means by landmark."""

from __future__ import annotations

import csv
from collections.abc import Callable
from copy import copy
from importlib import resources

import igl
import numpy as np
import scipy.sparse as sp
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.sparse.linalg import spsolve

from solver.anatomy.builtin_head import Head
from solver.anatomy.depths import Depth
from solver.surface import Floats, Ints

HIDDEN_PART_OF_LINING = 0.97
"""Skin that sees less than 3 % of its hemisphere is lining: mouth, eye sockets, nostrils."""

NO_BONE = "aperture"
"""Source of rows where there is no bone, which only say that it is not near."""

DIRECTIONS = 400
UNCHECKED = " Not yet compared with the printed table."
OFF_SKIN_MM = 0.05


class OuterSkin:
    """The skin that is seen from outside, with the openings of mouth and eyes closed in effect.

    The generalised winding number (Jacobson et al. 2013) of the visible faces alone is near one
    inside the head and near zero outside, also across the small openings, so that the mouth's
    cavity counts as inside.
    """

    def __init__(self, head: Head) -> None:
        self.vertices = head.neutral
        skin = head.faces[head.part_faces["skin"]]
        normals = igl.per_vertex_normals(self.vertices, skin)
        normals = np.nan_to_num(normals)
        hidden = _hidden_part(head, normals)
        hidden = np.minimum(hidden, hidden[head.mirror])
        self.visible_vertices: Ints = np.intersect1d(
            np.flatnonzero(hidden < HIDDEN_PART_OF_LINING), head.part_vertices["skin"]
        )
        visible = np.zeros(len(self.vertices), dtype=bool)
        visible[self.visible_vertices] = True
        self.faces: Ints = skin[visible[skin].all(axis=1)]
        self.normals: Floats = normals
        self._index()

    def _index(self) -> None:
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    def stretched_over(self, vertices: Ints) -> OuterSkin:
        """Return this skin with some vertices drawn tight between the others (harmonic).

        Muscles beside the ear run under the head's side, not along the ear.
        """
        edges = igl.adjacency_matrix(self.faces).astype(float).tocsr()
        laplacian = (sp.diags_array(edges.sum(axis=1).A1) - edges).tocsr()
        free = np.intersect1d(vertices, self.visible_vertices)
        rest = np.setdiff1d(np.unique(self.faces), free)
        tight = copy(self)
        tight.vertices = self.vertices.copy()
        tight.vertices[free] = spsolve(
            laplacian[free][:, free].tocsc(), -(laplacian[free][:, rest] @ self.vertices[rest])
        )
        tight.normals = np.nan_to_num(igl.per_vertex_normals(tight.vertices, self.faces))
        tight._index()
        return tight

    def closest(self, points: Floats) -> tuple[Floats, Ints, Floats]:
        """Return distance (k,), face (k,) and closest point (k, 3) of the visible skin."""
        squared, face, closest = self._tree.squared_distance(self.vertices, self.faces, points)
        return np.sqrt(squared), face, closest

    def interpolate(self, values: Floats, face: Ints, point: Floats) -> Floats:
        """Interpolate vertex ``values`` linearly at points (k, 3) of faces (k,)."""
        corners = self.faces[face]
        a, b, c = (self.vertices[corners[:, i]] for i in range(3))
        weights = igl.barycentric_coordinates(point, a, b, c)
        shape = (len(face), 3) + (1,) * (values.ndim - 1)
        return np.asarray((values[corners] * weights.reshape(shape)).sum(axis=1))

    def depth(self, points: Floats) -> tuple[Floats, Ints, Floats]:
        """Return the depth under the skin (k,), positive inside, and the face and point above."""
        distance, face, closest = self.closest(points)
        inside = igl.fast_winding_number(self.vertices, self.faces, points) > 0.5
        return np.where(inside, distance, -distance), face, closest


def _hidden_part(head: Head, normals: Floats) -> Floats:
    """Return for each vertex the part (n,) of directions above the skin that meet the head.

    Eyes, teeth and tongue hide the linings behind them.
    """
    number = np.arange(DIRECTIONS)
    height = 1 - (2 * number + 1) / DIRECTIONS
    turn = np.pi * (3 - np.sqrt(5)) * number
    around = np.sqrt(1 - height**2)
    sphere = np.stack([around * np.cos(turn), height, around * np.sin(turn)], -1)
    vertex, direction = np.nonzero(normals @ sphere.T > 0)
    rays = trimesh.Trimesh(head.neutral, head.faces, process=False).ray
    origins = head.neutral[vertex] + OFF_SKIN_MM * normals[vertex]
    meets = rays.intersects_any(origins, sphere[direction])  # type: ignore[no-untyped-call]
    counts = np.bincount(vertex, minlength=len(normals)).clip(1)
    return np.asarray(np.bincount(vertex, meets, minlength=len(normals)) / counts)


def depth_fields(head: Head) -> dict[str, Callable[[Floats], Floats]]:
    """Return bone name -> function from skin points (k, 3) to the depth of that bone (k,), mm.

    The table's means are interpolated with the radial kernel r, which passes through them.
    """
    rows = _read_table("soft_tissue_depths.csv")
    fields: dict[str, Callable[[Floats], Floats]] = {}
    for bone in ("cranium", "mandible"):
        sites, depths = [], []
        for row in (row for row in rows if row["bone"] == bone):
            for name in sides(head, row["landmark"]):
                sites.append(head.neutral[head.landmarks[name]])
                depths.append(float(row["depth_mm"]))
        fields[bone] = RBFInterpolator(np.array(sites), np.array(depths), kernel="linear")
    return fields


def depth_table(head: Head) -> tuple[Depth, ...]:
    """Return the depths with their references, one a landmark, where there is bone.

    Most were entered from memory of the cited tables: the reference says so until a row has been
    compared with the printed one (``checked``).
    """
    references = {row["key"]: row["reference"] for row in _read_table("sources.csv")}
    return tuple(
        Depth(
            name,
            row["bone"],
            float(row["depth_mm"]),
            None,
            references[row["source"]] + UNCHECKED * (row["checked"] == "no"),
        )
        for row in _read_table("soft_tissue_depths.csv")
        if row["source"] != NO_BONE
        for name in sides(head, row["landmark"])
    )


def _read_table(name: str) -> list[dict[str, str]]:
    with resources.files("solver.anatomy.data").joinpath(name).open() as stream:
        return list(csv.DictReader(stream))


def sides(head: Head, landmark: str) -> list[str]:
    """Return a mid-line landmark itself, or the left and right names of a paired one."""
    names = (landmark, f"{landmark}_l", f"{landmark}_r")
    return [name for name in names if name in head.landmarks]
