"""The built-in head: an adult of average shape, cropped at the neck, with 52 ARKit expressions.

MakeHuman's shapes and face units are displacements of one base mesh that simply add up. Lengths
here are mm, the axes are the project's, and the origin is MakeHuman's head joint, which lies
between the ear lobes.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.builtin_source import SourceFiles
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface

MM_PER_UNIT = 106.0
"""Decimetres to mm, times 1.06: the average MakeHuman head is small, and with this factor it has
an adult's measures (menton to vertex 227 mm, bizygomatic breadth 137 mm)."""

NECK_CUT_Y = -130.0
LEAST_WING_MM = 0.05

AVERAGE_ADULT = {
    f"macrodetails/{origin}-{sex}-young": 1 / 6
    for origin in ("african", "asian", "caucasian")
    for sex in ("female", "male")
} | {
    f"macrodetails/universal-{sex}-young-averagemuscle-averageweight": 1 / 2
    for sex in ("female", "male")
}
"""Shape targets and weights of the head that the anatomy is built in."""

PARTS = {
    "skin": "body",
    "tongue": "helper-tongue",
    "lower_teeth": "helper-lower-teeth",
    "upper_teeth": "helper-upper-teeth",
    "left_eye": "helper-l-eye",
    "right_eye": "helper-r-eye",
}
"""The parts that a scan of this topology keeps, with their groups in the base mesh."""

MIRRORED_PART = {"left_eye": "right_eye", "right_eye": "left_eye"}


@dataclass(frozen=True)
class Landmark:
    """A named vertex of the base mesh, at the mid-line or on the subject's left."""

    name: str
    base_vertex: int
    description: str


def read_landmarks() -> tuple[Landmark, ...]:
    """Return the landmark table of the built-in head."""
    with resources.files("solver.anatomy.data").joinpath("landmarks.csv").open() as stream:
        return tuple(
            Landmark(row["name"], int(row["base_vertex"]), row["description"])
            for row in csv.DictReader(stream)
        )


class Head:
    """The cropped topology, and the shapes it can take.

    ``faces`` (f, 3) are the triangles of all parts; ``part_vertices`` and ``part_faces`` number
    what belongs to each of :data:`PARTS`. The ``skin`` part is closed but for the neck: it has
    the lips' lining and mouth cavity, and a socket behind each eye.
    """

    def __init__(self, source: SourceFiles) -> None:
        self._source = source
        base = source.base_mesh
        self._rest = base.vertices + self._sum_targets(AVERAGE_ADULT)
        self._origin = self._rest[np.unique(base.groups["joint-head"])].mean(axis=0)
        above = ((self._rest - self._origin)[:, 1] * MM_PER_UNIT) > NECK_CUT_Y
        self._base_vertex = np.zeros(0, dtype=np.int64)
        self.faces: Ints = np.zeros((0, 3), dtype=np.int64)
        self.part_vertices: dict[str, Ints] = {}
        self.part_faces: dict[str, Ints] = {}
        for part, group in PARTS.items():
            triangles = base.groups[group]
            self._append(part, triangles[above[triangles].all(axis=1)])

    def _append(self, part: str, triangles: Ints) -> None:
        used, local = np.unique(triangles, return_inverse=True)
        first_vertex, first_face = len(self._base_vertex), len(self.faces)
        self.part_vertices[part] = np.arange(first_vertex, first_vertex + len(used))
        self.part_faces[part] = np.arange(first_face, first_face + len(triangles))
        self.faces = np.concatenate([self.faces, local.reshape(-1, 3) + first_vertex])
        self._base_vertex = np.concatenate([self._base_vertex, used])

    def _sum_targets(self, weights: Mapping[str, float]) -> Floats:
        total = np.zeros_like(self._source.base_mesh.vertices)
        for name, weight in weights.items():
            total += weight * self._source.shape_target(name)
        return total

    @cached_property
    def neutral(self) -> Floats:
        """(n, 3) vertices of the average adult at rest, mm."""
        return np.asarray(MM_PER_UNIT * (self._rest - self._origin)[self._base_vertex])

    @property
    def expression_names(self) -> tuple[str, ...]:
        """The 52 ARKit expression names."""
        return self._source.face_unit_names()

    @property
    def target_names(self) -> tuple[str, ...]:
        """The names of MakeHuman's shape targets, such as ``chin/chin-width-incr``."""
        return self._source.shape_target_names()

    def identity(self, targets: Mapping[str, float]) -> Floats:
        """Return the displacement (n, 3), mm, of weighted MakeHuman shape targets."""
        return MM_PER_UNIT * self._sum_targets(targets)[self._base_vertex]

    def expression(self, weights: Mapping[str, float]) -> Floats:
        """Return the displacement (n, 3), mm, of weighted ARKit expressions.

        Raises :class:`InputError` (``builtin.expression``) for a name that is not one of the 52.
        """
        total = np.zeros_like(self.neutral)
        for name, weight in weights.items():
            if name not in self.expression_names:
                raise InputError(
                    "builtin.expression",
                    f"{name} is not an expression of the built-in head",
                    expression=name,
                )
            total += weight * MM_PER_UNIT * self._source.face_unit(name)[self._base_vertex]
        return total

    def surface(
        self, expression: Mapping[str, float], identity: Mapping[str, float] | None = None
    ) -> Surface:
        """Return the head of one person (default: the average adult) in one expression."""
        vertices = self.neutral + self.identity(identity or {}) + self.expression(expression)
        return Surface(vertices, self.faces)

    @cached_property
    def ears(self) -> Ints:
        """Vertices of both ears: what MakeHuman moves when ears stand out."""
        wings = self.identity({f"ears/{side}-ear-wing-incr": 1.0 for side in "lr"})
        return np.flatnonzero(np.linalg.norm(wings, axis=1) > LEAST_WING_MM)

    @cached_property
    def mirror(self) -> Ints:
        """For each vertex, its mirror image across the mid-plane (nearest in the neutral)."""
        mirrored = self.neutral * np.array([-1.0, 1.0, 1.0])
        partner = np.arange(len(mirrored))
        for part, ids in self.part_vertices.items():
            others = self.part_vertices[MIRRORED_PART.get(part, part)]
            partner[ids] = others[cKDTree(self.neutral[others]).query(mirrored[ids])[1]]
        return partner

    @cached_property
    def landmarks(self) -> dict[str, int]:
        """Name -> vertex; paired landmarks get the suffixes ``_l`` and ``_r``."""
        number = {int(base): vertex for vertex, base in enumerate(self._base_vertex)}
        found: dict[str, int] = {}
        for landmark in read_landmarks():
            vertex = number[landmark.base_vertex]
            if abs(self.neutral[vertex, 0]) < 0.5:
                found[landmark.name] = vertex
            else:
                found[f"{landmark.name}_l"] = vertex
                found[f"{landmark.name}_r"] = int(self.mirror[vertex])
        return found
