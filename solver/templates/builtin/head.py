"""The built-in head: an adult of average shape, cropped at the neck, with 52 ARKit expressions.

MakeHuman's shapes and face units are displacements of one base mesh that simply add up. Lengths
here are mm, the axes are the project's, and the origin is MakeHuman's head joint, which lies
between the ear lobes.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import ShapeBasis
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface
from solver.templates.builtin.source import SourceFiles

# Decimetres to mm, times 1.06: the average MakeHuman head is small, and with this factor it has an
# adult's measures (menton to vertex 227 mm, bizygomatic breadth 137 mm).
MM_PER_UNIT = 106.0
NECK_CUT_Y = -130.0  # mm
LEAST_WING_MM = 0.05  # a vertex that moves more when ears stand out is one of an ear

# Shape targets and weights of the head that the anatomy is built in.
AVERAGE_ADULT = {
    f"macrodetails/{origin}-{sex}-young": 1 / 6
    for origin in ("african", "asian", "caucasian")
    for sex in ("female", "male")
} | {
    f"macrodetails/universal-{sex}-young-averagemuscle-averageweight": 1 / 2
    for sex in ("female", "male")
}

# The parts that a scan of this topology keeps, with their groups in the base mesh.
PARTS = {
    "skin": "body",
    "tongue": "helper-tongue",
    "lower_teeth": "helper-lower-teeth",
    "upper_teeth": "helper-upper-teeth",
    "left_eye": "helper-l-eye",
    "right_eye": "helper-r-eye",
}

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


# Variation of the built-in head: MakeHuman's face shapes as identities, ARKit's expressions.
#
# The shapes come without statistics. Sex and origin are those of a population with equal shares;
# the standard deviations of all others are set by eye, so that two of them still make a common
# face.

ORIGINS = ("african", "asian", "caucasian")
SEXES = ("female", "male")
FACE_FOLDERS = (
    "head",
    "forehead",
    "eyebrows",
    "eyes",
    "ears",
    "nose",
    "mouth",
    "cheek",
    "chin",
    "neck",
)
OPPOSITES = (
    ("decr", "incr"),
    ("down", "up"),
    ("backward", "forward"),
    ("in", "out"),
    ("concave", "convex"),
    ("compress", "uncompress"),
)
# Strength of one of two opposite shapes in somebody one standard deviation from the average; parts
# of the way from 25 to 90 years, and from average to the greatest weight or muscle.
PAIR_SD, AGE_SD, BUILD_SD = 0.3, 0.3, 0.5


def shape_basis(head: Head) -> ShapeBasis:
    """Return the identities (macro shapes, then pairs of face shapes) and the 52 expressions.

    Shapes of the left and the right side count as one; those that make a face askew are identities
    of their own.
    """
    identities = np.stack([head.identity(weights) for weights in [*_macros(), *_pairs(head)]])
    # A taller body lifts the head: where the head is, is not part of its shape.
    skin = head.part_vertices["skin"]
    identities -= identities[:, skin].mean(axis=1, keepdims=True)
    names = head.expression_names
    expressions = np.stack([head.expression({name: 1.0}) for name in names])
    return ShapeBasis(identities.astype(np.float32), expressions.astype(np.float32), names)


def _macros() -> list[dict[str, float]]:
    """Return the weights of shape targets for sex, origin (two), age, weight and muscle."""
    young = {
        (origin, sex): f"macrodetails/{origin}-{sex}-young" for origin in ORIGINS for sex in SEXES
    }
    sign = {"female": -1.0, "male": 1.0}
    body = "macrodetails/universal-{}-young-{}muscle-{}weight"
    sex = {name: sign[key[1]] / 6 for key, name in young.items()}
    sex |= {body.format(each, "average", "average"): sign[each] / 2 for each in SEXES}
    # Two orthonormal contrasts of three equal shares: each has the variance 1/3 (multinomial).
    contrasts = np.sqrt(1 / 3) * np.array([[1, -1, 0], [1, 1, -2]]) / np.sqrt([[2], [6]])
    origins = [
        {name: contrast[ORIGINS.index(key[0])] / 2 for key, name in young.items()}
        for contrast in contrasts
    ]
    age = dict.fromkeys(young.values(), -AGE_SD / 6)
    age |= {name.replace("young", "old"): AGE_SD / 6 for name in young.values()}
    for each in SEXES:
        average = body.format(each, "average", "average")
        age |= {average: -AGE_SD / 2, average.replace("young", "old"): AGE_SD / 2}
    # From the least to the greatest is twice the way from the average: hence a quarter a sex.
    weight, muscle = (
        {
            body.format(each, *levels(end)): BUILD_SD / 4 * (1 if end == "max" else -1)
            for each, end in itertools.product(SEXES, ("min", "max"))
        }
        for levels in (lambda end: ("average", end), lambda end: (end, "average"))
    )
    return [sex, *origins, age, weight, muscle]


def _pairs(head: Head) -> list[dict[str, float]]:
    """Return the weights of each pair of opposite shapes; moves of the whole head are left out."""
    names = set(head.target_names)
    pairs = []
    for name in sorted(names):
        folder, _, shape = name.partition("/")
        if folder == "asym" and shape.endswith("-l") and shape.startswith("asym-"):
            pairs.append({name: PAIR_SD / 2, f"{name[:-1]}r": -PAIR_SD / 2})
        if folder not in FACE_FOLDERS or shape.startswith(("r-", "head-trans")):
            continue
        for low, high in OPPOSITES:
            opposite = f"{name.removesuffix(low)}{high}"
            if name.endswith(f"-{low}") and opposite in names:
                pairs.append(_both_sides({name: -PAIR_SD / 2, opposite: PAIR_SD / 2}))
    return pairs


def _both_sides(weights: dict[str, float]) -> dict[str, float]:
    return weights | {name.replace("/l-", "/r-"): weight for name, weight in weights.items()}
