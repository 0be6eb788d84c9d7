"""The template anatomy: skull, jaw and muscles inside one skin topology.

A registered scan of any person has the template's skin topology (same vertex count and order), so
the template's anatomy can be carried into that person by correspondence. A template is stored as
one NPZ file without pickles.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.anatomy.embedding import rows_of, shares_in_tets
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.errors import InputError
from solver.storage import Archive, Arrays, csr_arrays, csr_from, with_prefix
from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class Depth:
    """The depth of a bone under a landmark of the skin, by a table."""

    landmark: str
    bone: str  # cranium or mandible
    mean: float  # mm
    deviation: float | None  # standard deviation over persons in mm, None where it is not known
    source: str


@dataclass(frozen=True)
class ShapeBasis:
    """Linear shapes of a template's skin, displacements in mm from the template's neutral."""

    # (k, n, 3) one standard deviation of each component; coefficients are independent with unit
    # variance. k = 0 where nothing is known.
    identity: NDArray[np.float32]
    expressions: NDArray[np.float32]  # (e, n, 3) each at weight 1; weights lie in [0, 1]
    expression_names: tuple[str, ...]  # (e,) as ARKit calls them where it has one


# corrective expression -> the one that it corrects: it is added where that one is
CORRECTED = {"mouthClose": "jawOpen"}

# expressions of ARKit that move the whole face to one side, not one side of it
_SIDEWAYS = ("jawLeft", "jawRight", "mouthLeft", "mouthRight")


def split_side(expression: str) -> tuple[str, str]:
    """Return ARKit's name of an expression without its side, and that: left, right or none.

    ``mouthSmileLeft`` is ``mouthSmile`` on the ``left``.
    """
    for side in ("Left", "Right"):
        if expression.endswith(side) and expression not in _SIDEWAYS:
            return expression.removesuffix(side), side.lower()
    return expression, ""


def check_arrays(template: Template, file: str) -> None:
    """Check a template's arrays; ``file`` is named in the message.

    Raises :class:`InputError`, ``template.shape``, ``template.nan`` or ``template.range``, with the
    ``array``'s name.
    """
    check = _Check(file)
    for name in SURFACES:
        check.surface(name, getattr(template, name))
    skin = len(template.skin.vertices)
    mesh = template.mesh
    check.numbers("flesh_faces", template.flesh_faces, len(template.skin.faces))
    for name in VERTEX_SETS:
        check.numbers(name, getattr(template, name), skin)
    for name in ("flesh_faces", "face_vertices"):
        if not len(getattr(template, name)):
            check.wrong("shape", name, "is empty")
    for name, ids in template.regions.items():
        check.numbers(f"region {name}", ids, skin)
    for name, vertex in template.landmarks.items():
        check.numbers(f"landmark {name}", np.array([vertex]), skin)
    check.points("parting", template.parting, (skin, 3))
    check.points("condyles", template.condyles, (2, 3))
    check.points("planes", np.array([template.back_z, template.bottom_y]), (2,))
    for muscle in template.muscles:
        check.surface(f"muscle {muscle.name}", muscle.surface)
        check.points(f"axis of muscle {muscle.name}", muscle.axis, (3, 3))
    if template.shapes is not None:
        shapes = template.shapes
        check.points("identity shapes", shapes.identity, (None, skin, 3))
        check.points("expressions", shapes.expressions, (len(shapes.expression_names), skin, 3))
    if template.points is not None:
        check.skin_points(template.points, skin)
    if template.texture is not None:
        check.texture(template.texture, len(template.skin.faces))
    if mesh is not None:
        weights = mesh.weights
        count = len(mesh.vertices)
        check.points("mesh vertices", mesh.vertices, (None, 3))
        check.numbers("mesh tets", mesh.tets, count, columns=4)
        limits = dict.fromkeys(("cranium", "mandible", "cut"), count)
        limits |= {"embedded": skin, "attached_mandible": skin, "embedded_in": len(mesh.tets)}
        for name, limit in limits.items():
            check.numbers(f"mesh {name}", getattr(mesh, name), limit)
        check.points("mesh shares", mesh.shares, (len(mesh.embedded_in), 4))
        check.points("mesh weights", weights.data, (len(weights.indices),))
        if mesh.trained is not None:
            check.points("mesh trained", mesh.trained, (len(weights.indices),))
        check.numbers("mesh weights", weights.indices, weights.shape[1])
        found = {"weights": weights.shape[0], "embedded_in": len(mesh.embedded_in)}
        for name, wanted in (("weights", len(mesh.tets)), ("embedded_in", len(mesh.embedded))):
            if found[name] != wanted:
                check.wrong("shape", f"mesh {name}", f"has {found[name]} rows, not {wanted}")


SLACK = 1e-6  # of barycentric coordinates, by rounding


class _Check:
    def __init__(self, file: str) -> None:
        self._file = file

    def wrong(self, code: str, array: str, what: str) -> None:
        reason = f"{self._file}: {array} {what}"
        raise InputError(f"template.{code}", reason, file=self._file, array=array)

    def points(self, name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
        fits = array.ndim == len(shape) and all(
            wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fi":
            wanted = " x ".join("any" if n is None else str(n) for n in shape)
            self.wrong("shape", name, f"has shape {array.shape} of {array.dtype}, not {wanted}")
        if not np.isfinite(array).all():
            place = np.argwhere(~np.isfinite(array))[0]
            self.wrong("nan", name, f"has an entry that is not finite, at {place.tolist()}")

    def numbers(self, name: str, array: np.ndarray, count: int, columns: int = 0) -> None:
        fits = array.shape[1:] == ((columns,) if columns else ()) and array.ndim > 0
        if not fits or array.dtype.kind != "i":
            self.wrong("shape", name, f"has shape {array.shape} of {array.dtype}")
        outside = np.argwhere((array < 0) | (array >= count))
        if len(outside):
            place = tuple(outside[0])
            self.wrong("range", name, f"has {array[place]} at {list(map(int, place))}, of {count}")

    def skin_points(self, points: SkinPoints, skin: int) -> None:
        names = points.names
        weights = points.weights
        if len(set(names)) < len(names):
            self.wrong("shape", "names of points", "are no different ones")
        self.points("weights of points", weights, (len(names), 3))
        self.points("spread of points", points.spread_mm, (len(names),))
        self.numbers("corners of points", points.corners, skin, columns=3)
        if len(points.corners) != len(names):
            found = f"has {len(points.corners)} rows, not {len(names)}"
            self.wrong("shape", "corners of points", found)
        off = np.maximum(-weights.min(axis=1), np.abs(weights.sum(axis=1) - 1.0))
        if off.max(initial=0.0) > SLACK:
            found = f"has {weights[off.argmax()].tolist()} at [{off.argmax()}]: not in a triangle"
            self.wrong("range", "weights of points", found)
        if points.spread_mm.min(initial=1.0) <= 0.0:
            self.wrong("range", "spread of points", "has an entry that is not positive")

    def texture(self, texture: TextureCoordinates, faces: int) -> None:
        self.points("texture places", texture.places, (None, 2))
        corners = texture.corners
        if len(corners) != faces:
            self.wrong("shape", "texture corners", f"has {len(corners)} rows, not {faces}")
        self.numbers("texture corners", corners - NOWHERE, len(texture.places) + 1, columns=3)

    def surface(self, name: str, surface: Surface) -> None:
        self.points(f"{name} vertices", surface.vertices, (None, 3))
        self.numbers(f"{name} faces", surface.faces, len(surface.vertices), columns=3)


@dataclass(frozen=True)
class TemplateMesh:
    """Tetrahedra of the flesh in the neutral pose; mm."""

    edge_mm: float  # the edge length on the face that was asked for
    vertices: Floats  # (p, 3) at rest
    tets: Ints  # (n, 4) of positive volume
    # Vertices on the bones and on the cut planes, disjoint; on some of the cranium's the flesh
    # glides (:func:`solver.anatomy.bones.gliding`).
    cranium: Ints
    mandible: Ints
    cut: Ints
    embedded: Ints  # (e,) skin vertices that follow the flesh
    embedded_in: Ints  # (e,) the tets under them
    shares: Floats  # (e, 4) coordinates there of their nearest point on the flesh's outside, >= 0
    attached_mandible: Ints  # skin vertices that move rigidly with the mandible
    weights: sp.csr_array  # (n, m + 1) geometric S, which every person shares
    # (nnz,) the values of S in its pattern that the template's own expressions ask for
    # (solver.fitting.training), with compartments or without; None where nobody trained it
    trained: NDArray[np.float32] | None = None

    @property
    def centres(self) -> Floats:
        """Return the middles (n, 3) of the tets."""
        return np.asarray(self.vertices[self.tets].mean(axis=1))

    def trained_like(self, other: TemplateMesh) -> NDArray[np.float32] | None:
        """Return the trained values at the nearest ``other`` tets of the same muscles.

        Both fill the same flesh. A row without any value there keeps its geometric S.
        """
        if other.trained is None:
            return None
        there = sp.csr_array(
            (other.trained, other.weights.indices, other.weights.indptr), shape=other.weights.shape
        )
        nearest = cKDTree(other.centres).query(self.centres)[1]
        own = self.weights
        row = np.repeat(np.arange(own.shape[0]), np.diff(own.indptr))
        values = np.asarray(there[nearest[row], own.indices]).ravel()
        total = np.bincount(row, values, own.shape[0])[row]
        found = np.divide(values, total, out=own.data.copy(), where=total > 0.0)
        return np.asarray(found, dtype=np.float32)

    @property
    def surface_rows(self) -> sp.csr_array:
        """Return rows (e, p) that carry each embedded vertex's point on the flesh's outside."""
        return rows_of(self.tets[self.embedded_in], self.shares, len(self.vertices))

    def embedding(self, skin: Floats) -> sp.csr_array:
        """Return rows (e, p) that carry the embedded vertices of ``skin`` (n, 3) themselves."""
        corners = self.tets[self.embedded_in]
        shares = shares_in_tets(skin[self.embedded], self.vertices, corners, self.shares)
        return rows_of(corners, shares, len(self.vertices))

    def arrays(self) -> Arrays:
        """Return the mesh as named arrays, for a file."""
        plain = {name: np.asarray(getattr(self, name)) for name in MESH_PLAIN}
        if self.trained is not None:
            plain["trained"] = self.trained
        return plain | csr_arrays("weights", self.weights)

    @classmethod
    def from_arrays(cls, arrays: Arrays, muscle_count: int) -> TemplateMesh:
        """Return the mesh that :meth:`arrays` described."""
        plain: dict[str, Any] = {name: arrays[name] for name in MESH_PLAIN}
        plain["edge_mm"] = float(plain["edge_mm"])
        if "sliding" in arrays:  # files of before there were facial spaces
            plain["cranium"] = np.union1d(plain["cranium"], arrays["sliding"])
        weights = csr_from("weights", arrays, muscle_count + 1)
        return cls(**plain, weights=weights, trained=arrays.get("trained"))


# arrays of a mesh that are stored as they are, with its edge length
MESH_PLAIN = tuple(f.name for f in fields(TemplateMesh) if f.name not in ("weights", "trained"))
FORMAT = 1  # of the file
SURFACES = ("skin", "cranium", "mandible")
VERTEX_SETS = ("face_vertices", "attached_cranium", "attached_mandible")
PLAIN = ("flesh_faces", *VERTEX_SETS, "parting", "condyles")  # arrays that are stored as they are


Cut = Literal["sectors", "lateral", "superior", "anterior", "outward"]
CUTS = get_args(Cut)
AGAIN = " | "  # in the cells of a table, between a cut and the next one


@dataclass(frozen=True)
class Compartments:
    """The parts of a muscle that contract on their own, of equal volume.

    ``sectors`` follow each other along the fibres: around a ring from its top outwards (of a
    muscle in the middle: to the subject's left), else from origin to insertion. Any other ``cut``
    makes strips along the fibres, side by side in that direction: ``outward`` leads from a ring's
    middle. ``names`` are in that order. Each part may be cut again, ``within`` itself: the parts of
    that have both names, ``lateral.marginal``.
    """

    cut: Cut
    names: tuple[str, ...]
    within: Compartments | None = None

    @classmethod
    def read(cls, cut: str, names: str) -> Compartments | None:
        """Read compartments from two cells of a table, names between semicolons; None if empty.

        :data:`AGAIN` stands between cuts, and between their names. Raises :class:`ValueError` in
        words.
        """
        if not cut and not names:
            return None
        (cut, *cuts), (listed, *more) = cut.split(AGAIN), names.split(AGAIN)
        if len(cuts) != len(more):
            raise ValueError(f"there are {len(cuts) + 1} cuts, and names of {len(more) + 1}")
        if cut not in CUTS:
            raise ValueError(f"cut is none of {', '.join(CUTS)}: {cut!r}")
        given = tuple(name.strip() for name in listed.split(";"))
        if len(given) < 2 or len(set(given)) < len(given) or not all(given):
            raise ValueError(f"compartments are no different names, at least two: {listed!r}")
        if any("." in name for name in given):
            raise ValueError(f"a compartment's name has a dot: {listed!r}")
        return cls(cast(Cut, cut), given, cls.read(AGAIN.join(cuts), AGAIN.join(more)))

    @property
    def cuts(self) -> tuple[Compartments, ...]:
        """Return these, and those within each of them."""
        return (self, *(self.within.cuts if self.within else ()))

    @property
    def all_names(self) -> tuple[str, ...]:
        """Return the names of the parts that are not cut any more, in the order of their cuts."""
        listed = product(*(each.names for each in self.cuts))
        return tuple(".".join(names) for names in listed)

    @property
    def cells(self) -> tuple[str, str]:
        """Return the two cells of a table that :meth:`read` has them from."""
        cuts = AGAIN.join(each.cut for each in self.cuts)
        return cuts, AGAIN.join("; ".join(each.names) for each in self.cuts)


@dataclass(frozen=True)
class Muscle:
    """One muscle. Without ``compartments`` it contracts as one."""

    name: str
    surface: Surface  # closed enough, in mm
    fibre: Floats  # (3,) unit, the main direction, from origin (bone) to insertion (skin)
    origin: Floats  # (3,) centre of the attachment, mm
    insertion: Floats  # (3,) likewise
    ring: bool = False  # its fibres run around an opening
    compartments: Compartments | None = None

    @property
    def compartment_names(self) -> tuple[str, ...]:
        """Return the names of the compartments after the muscle's, or that of the whole."""
        if self.compartments is None:
            return (self.name,)
        return tuple(f"{self.name}.{part}" for part in self.compartments.all_names)

    @property
    def axis(self) -> Floats:
        """Return fibre, origin and insertion, (3, 3)."""
        return np.stack([self.fibre, self.origin, self.insertion])


@dataclass(frozen=True)
class Template:
    """Template anatomy in mm; x to the subject's left, y up, z forward."""

    name: str
    version: str
    source: str
    skin: Surface  # the whole registered-scan topology at rest: every vertex a scan must have
    # (k,) skin faces that bound the flesh (face, neck, lips, lining of mouth and eyelids), as
    # opposed to eyeballs, teeth, tongue and lashes.
    flesh_faces: Ints
    face_vertices: Ints  # (k,) skin vertices that are fitted and on which errors are reported
    attached_cranium: Ints  # skin vertices that move rigidly with it: eyes, upper teeth, scalp
    attached_mandible: Ints  # the same: lower teeth, tongue
    parting: Floats  # (n, 3) displacement that parts the closed lips (and lids) enough to mesh them
    cranium: Surface  # watertight, bounds the flesh from inside
    mandible: Surface  # the same
    muscles: tuple[Muscle, ...]
    condyles: Floats  # (2, 3) centres of the left and right one
    back_z: float  # behind it there is no flesh: its tets end there, held fixed
    bottom_y: float  # the same below it
    landmarks: dict[str, int] = field(default_factory=dict)  # name -> skin vertex
    regions: dict[str, Ints] = field(default_factory=dict)  # for reports
    shapes: ShapeBasis | None = None  # how the skin varies, where that is known
    licence: str = ""  # what it may be used for, by its sources; empty where nobody said
    depths: tuple[Depth, ...] = ()  # of soft tissue, that the bones were placed by
    mesh: TemplateMesh | None = None  # that every person's model shares, where it is made
    points: SkinPoints | None = None  # that a detector marks in pictures, where they were found
    texture: TextureCoordinates | None = None  # of the skin in an image of its colours

    @property
    def parted_skin(self) -> Surface:
        """Return the skin with the lips parted."""
        return self.skin.with_vertices(self.skin.vertices + self.parting)

    @property
    def flesh(self) -> Surface:
        """Return the part of the skin that bounds the flesh, with all vertices of the skin."""
        return Surface(self.skin.vertices, self.skin.faces[self.flesh_faces])

    @property
    def parted_flesh(self) -> Surface:
        """Return :attr:`flesh` with the lips parted."""
        return self.flesh.with_vertices(self.skin.vertices + self.parting)

    @property
    def without_compartments(self) -> Template:
        """Return the template with every muscle in one piece."""
        whole = tuple(replace(muscle, compartments=None) for muscle in self.muscles)
        return replace(self, muscles=whole)

    @property
    def sha256(self) -> str:
        """Return the hash of all that models and rigs are made of: texture coordinates are not."""
        return replace(self, texture=None)._archive().sha256

    def save(self, path: Path) -> str:
        """Write the template as NPZ and return its :attr:`sha256`."""
        self._archive().write(path)
        return self.sha256

    @classmethod
    def load(cls, path: Path) -> Template:
        """Read a template written by :meth:`save`.

        Raises :class:`InputError`: ``template.unreadable`` or ``template.format`` if the file is
        not one, else as :func:`check_arrays`.
        """
        archive = Archive.read(path, "template", "a template", FORMAT)
        try:
            template = cls._from_archive(archive)
        except (KeyError, TypeError, ValueError) as error:
            reason = f"{path.name} is not a template: {error}"
            raise InputError("template.unreadable", reason, file=path.name) from error
        check_arrays(template, path.name)
        return template

    def _archive(self) -> Archive:
        arrays: Arrays = {name: getattr(self, name) for name in PLAIN}
        arrays["planes"] = np.array([self.back_z, self.bottom_y])
        surfaces = {name: getattr(self, name) for name in SURFACES}
        for number, muscle in enumerate(self.muscles):
            surfaces[f"muscle_{number}"] = muscle.surface
            arrays[f"muscle_{number}_axis"] = muscle.axis
        for name, surface in surfaces.items():
            arrays[f"{name}_vertices"] = surface.vertices
            arrays[f"{name}_faces"] = surface.faces
        arrays |= {f"region_{name}": ids for name, ids in self.regions.items()}
        if self.shapes is not None:
            arrays["shapes_identity"] = self.shapes.identity
            arrays["shapes_expressions"] = self.shapes.expressions
        if self.mesh is not None:
            arrays |= {f"mesh_{name}": array for name, array in self.mesh.arrays().items()}
        if self.points is not None:  # other templates keep their hash
            arrays |= {f"points_{name}": array for name, array in self.points.arrays().items()}
        if self.texture is not None:
            arrays |= {f"texture_{name}": array for name, array in self.texture.arrays().items()}
        header = {
            "format": FORMAT,
            "name": self.name,
            "version": self.version,
            "source": self.source,
            "muscles": [muscle.name for muscle in self.muscles],
            "landmarks": self.landmarks,
            "expression_names": self.shapes.expression_names if self.shapes else (),
            "rings": [muscle.name for muscle in self.muscles if muscle.ring],
            "licence": self.licence,
            "depths": [astuple(depth) for depth in self.depths],
        }
        divided = {}
        for muscle in self.muscles:
            if muscle.compartments:
                cut, names = muscle.compartments.cells
                divided[muscle.name] = cut, names.split("; ")
        if divided:  # other templates keep their hash
            header["compartments"] = divided
        return Archive(header, arrays)

    @classmethod
    def _from_archive(cls, archive: Archive) -> Template:
        header = archive.header
        data = archive.arrays

        def surface(name: str) -> Surface:
            return Surface(data[f"{name}_vertices"], data[f"{name}_faces"])

        muscles = []
        divided = dict(header.get("compartments", {}))
        for number, name in enumerate(header["muscles"]):
            ring = name in header.get("rings", ())
            fibre, origin, insertion = data[f"muscle_{number}_axis"]
            bounds = surface(f"muscle_{number}")
            cut, parts = divided.get(name, ("", ()))
            compartments = Compartments.read(cut, "; ".join(parts))
            muscles.append(Muscle(name, bounds, fibre, origin, insertion, ring, compartments))
        shapes = None
        if "shapes_identity" in data:
            names = tuple(header["expression_names"])
            shapes = ShapeBasis(data["shapes_identity"], data["shapes_expressions"], names)
        mesh = with_prefix(data, "mesh_")
        points = with_prefix(data, "points_")
        texture = with_prefix(data, "texture_")
        back_z, bottom_y = data["planes"]
        plain: dict[str, Any] = {name: data[name] for name in PLAIN}
        plain |= {name: surface(name) for name in SURFACES}
        plain |= {name: header[name] for name in ("name", "version", "source")}
        return cls(
            **plain,
            muscles=tuple(muscles),
            back_z=float(back_z),
            bottom_y=float(bottom_y),
            landmarks=dict(header["landmarks"]),
            regions=with_prefix(data, "region_"),
            shapes=shapes,
            licence=header.get("licence", ""),
            depths=tuple(Depth(*row) for row in header.get("depths", ())),
            mesh=TemplateMesh.from_arrays(mesh, len(muscles)) if mesh else None,
            points=SkinPoints.from_arrays(points) if points else None,
            texture=TextureCoordinates.from_arrays(texture) if texture else None,
        )
