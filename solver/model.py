"""The subject model: one person's flesh as tetrahedra, with bones, muscles and skin embedding.

It is what ``build_model`` makes, what every fit reads, and is stored as one NPZ file.
"""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.errors import InputError, quote
from solver.kinds import FILES
from solver.storage import Archive, Arrays, csr_arrays, csr_from, with_prefix
from solver.surface import Floats, Ints, Surface, part_of

FORMAT = FILES["model.npz"].format
# Where a person's size comes from: the scan; the template, as the scan was in no known unit; the
# face, by which the scan's unit was guessed; photographs, where there is no scan at all.
SizeFrom = Literal["scan", "template", "guess", "photographs"]
SIZE_WORDS: dict[SizeFrom, str] = {
    "template": "size unknown: taken from the template, millimetres are estimates",
    "guess": "size guessed: no unit was given, and the face alone does not tell it for sure",
    "photographs": "estimated from photographs, not scanned: the face is the likeliest of its "
    "template's people, and millimetres are estimates",
}
# fields of a model that are arrays, stored as they are
ARRAYS = (
    *("rest", "tets", "cranium", "mandible", "cut", "sliding"),
    *("embedded", "offset", "attached_mandible", "face"),
)


@dataclass(frozen=True)
class CondyleTracks:
    """Ways of the condyles in their sockets: straight, and alike on both sides."""

    slope: float  # below the jaw frame's third axis, rad
    apart: float  # distance of the condyles, mm
    length: float  # the furthest slide, mm
    opening: float  # the greatest rotation of the hinge, rad


@dataclass(frozen=True)
class JawFrame:
    """The mandible's five degrees of freedom b (ARCHITECTURE.md, the equations: jaw).

    ``origin`` (3,) lies half way between the condyles; ``axes`` (3, 3) has rows: the unit vector
    through the condyles (to the subject's left), the vertical axis, and their cross product.
    b = (rotation about row 0, rotation sideways, translation along rows 0, 1, 2), rad and mm.

    Sideways the mandible turns in the plane of the ``tracks``, so that b can say all motions along
    them (:mod:`solver.mechanics.jaw_tracks`); about row 1 in models made before they had tracks.
    """

    origin: Floats
    axes: Floats
    tracks: CondyleTracks | None = None

    @property
    def turning(self) -> Floats:
        """Return the axes (3, 3) that rotations are about: hinge, sideways, their cross product."""
        across, up, ahead = self.axes
        slope = self.tracks.slope if self.tracks else 0.0
        sideways = np.cos(slope) * up + np.sin(slope) * ahead
        return np.stack([across, sideways, np.cross(across, sideways)])


@dataclass(frozen=True)
class Expressions:
    """The template's expressions on a person: what scans are likely to be made of.

    ``motions`` (e, k, 3) float32 are those of the face's points at full strength, mm.
    """

    names: tuple[str, ...]
    motions: NDArray[np.float32]


def lower_teeth(regions: Mapping[str, Ints], attached_mandible: Ints) -> Ints:
    """Return the skin vertices of the lower teeth; all on the mandible if none are named."""
    teeth = np.intersect1d(regions.get("lower_teeth", []), attached_mandible)
    return np.asarray(teeth, np.int64) if len(teeth) else attached_mandible


# Names of muscles. A compartment, and a strip of one, has the whole's name and its own after a dot:
# ``frontalis_l.medial``. A compartment's parts do likewise: ``orbicularis_oris_upper_l.lateral``
# means all parts of that name, ``orbicularis_oris_upper_l.lateral.marginal`` one of them. Sides are
# words: ``left`` or ``l``, ``right`` or ``r``.

Value = TypeVar("Value")
OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}


def name_words(muscle: str) -> list[str]:
    """Return the words of a muscle's name: ``frontalis_l.medial`` -> frontalis, l, medial."""
    return re.split(r"[\s_.]+", muscle)


def find_muscles(name: str, muscles: Sequence[str]) -> list[int]:
    """Return the numbers of the ``muscles`` that a name means: its own, or all parts of a whole."""
    parts = f"{name}."
    return [k for k, each in enumerate(muscles) if each == name or each.startswith(parts)]


def tell_muscles(name: str, muscles: Sequence[str]) -> str:
    """Return the ``muscles`` that somebody who wrote ``name`` may have meant, in words."""
    wholes = list(dict.fromkeys(each.partition(".")[0] for each in muscles))
    near = difflib.get_close_matches(name, [*muscles, *wholes], 4)
    near += [each for each in wholes if each.startswith(f"{name}_")]
    if not near:
        return f"it has {', '.join(wholes)}"
    whole = near[0].partition(".")[0]
    parts = [muscles[number] for number in find_muscles(whole, muscles)]
    words = f"did you mean {', '.join(dict.fromkeys(near))}?"
    return words if parts == [whole] else f"{words} {whole} has the parts {', '.join(parts)}"


def by_muscle(given: Mapping[str, Value], muscles: Sequence[str]) -> dict[str, Value]:
    """Return muscle -> the value ``given`` for it by its own name, else for its whole's."""
    return {
        muscles[number]: given[name]
        for name in sorted(given, key=len)
        for number in find_muscles(name, muscles)
    }


@dataclass(frozen=True)
class SubjectModel:
    """Tetrahedral face of one person; mm, x to the subject's left, y up, z forward.

    Column 0 of S is passive flesh, column j the muscle ``muscle_names[j - 1]``. The pattern of
    ``weights`` is the candidates (passive column and the muscles within 10 mm of a tet; explicit
    zeros are kept), rows sum to one.

    Skin vertices follow the flesh, at embedding @ x + offset with barycentric rows, or move rigidly
    with the mandible; those that are in neither list stay with the cranium.

    ``mesh_source`` is ``transport`` if the tets are the template's, ``mesher`` if they were made
    for this person, then with the reason if transport was tried. ``fibres`` run from origin to
    insertion or around a ring, and are zero in the passive column; None in models made before them.

    The m muscles are whole ones or compartments; then ``wholes`` names the whole of each. In a
    model without compartments it is empty.
    """

    rest: Floats  # (p, 3) vertices
    tets: Ints  # (n, 4) vertex numbers, every rest volume positive
    cranium: Ints  # vertices fixed to the cranium
    mandible: Ints  # vertices that move with the mandible
    cut: Ints  # vertices fixed on the cut planes
    sliding: Ints  # vertices free on the plane along the cranium, see solver.mechanics.terms
    muscle_names: tuple[str, ...]  # the m muscles
    weights: sp.csr_array  # (n, m + 1) initial S
    skin: Surface  # the whole scan topology in the subject's neutral pose
    embedded: Ints  # (e,) skin vertices that follow the flesh
    embedding: sp.csr_array  # (e, p)
    offset: Floats  # (e, 3)
    attached_mandible: Ints  # skin vertices that move rigidly with the mandible
    face: Ints  # (k,) of ``embedded``: skin vertices on which targets and errors are taken
    jaw: JawFrame
    muscles: dict[str, Surface]  # the whole ones in the subject, for pictures and exports
    bones: dict[str, Surface]
    regions: dict[str, Ints]  # name -> skin vertices, for reports
    template: dict[str, str]  # its name, version and sha256
    mesh_source: str = "mesher"
    fibres: Floats | None = None  # (nnz, 3) unit directions, one for each entry of ``weights``
    size_from: SizeFrom = "scan"
    wholes: tuple[str, ...] = ()  # (m,) the whole muscle of each compartment
    expressions: Expressions | None = None  # None in models made before them, or without shapes
    # (nnz,) values of S in the pattern of ``weights``, by the training of the template; None where
    # nobody trained it, or where the tets are the person's own
    trained: NDArray[np.float32] | None = None

    @property
    def lower_teeth(self) -> Ints:
        """Return the skin vertices of the lower teeth; all on the mandible if none are named."""
        return lower_teeth(self.regions, self.attached_mandible)

    def region(self, name: str) -> Ints:
        """Return the skin vertices (k,) of a region; none if the model does not name it."""
        return self.regions.get(name, np.empty(0, np.int64))

    @property
    def jaw_front(self) -> Floats:
        """Return the foremost point (1, 3) of the lower teeth, mm; of the chin without any."""
        teeth = self.lower_teeth
        bone = self.skin.vertices[teeth] if len(teeth) else self.rest[self.mandible]
        return np.asarray(bone[[(bone @ self.jaw.axes[2]).argmax()]])

    @property
    def flesh_faces(self) -> Ints:
        """Return the skin's triangles (f, 3) that follow the flesh."""
        return self.skin.faces[np.isin(self.skin.faces, self.embedded).all(axis=1)]

    @property
    def face_triangles(self) -> Ints:
        """Return the skin's triangles (f, 3) within the face, by numbers of the face's points."""
        number = np.full(len(self.skin.vertices), -1)
        number[self.face] = np.arange(len(self.face))
        triangles = number[self.skin.faces]
        return np.asarray(triangles[(triangles >= 0).all(axis=1)])

    @property
    def muscle_count(self) -> int:
        """Return m, the number of muscles (the passive column not counted)."""
        return len(self.muscle_names)

    @property
    def tet_centres(self) -> Floats:
        """Return the middles (n, 3) of the tets at rest, mm."""
        return np.asarray(self.rest[self.tets].mean(axis=1))

    @property
    def muscle_groups(self) -> tuple[str, ...]:
        """Return the name (m,) of the whole muscle that each muscle is a compartment of, or is."""
        return self.wholes or self.muscle_names

    @property
    def muscle_surfaces(self) -> dict[str, Surface]:
        """Return muscle -> surface: a compartment has the triangles of the whole nearest to it."""
        centres = self.tet_centres
        entries = self.weights.tocoo()
        found = {}
        for name, whole in self.muscles.items():
            columns = [k for k, group in enumerate(self.muscle_groups, start=1) if group == name]
            own = np.isin(entries.col, columns) & (entries.data > 0.0)
            if len(columns) < 2 or not own.any():
                found[name] = whole
                continue
            middles = whole.vertices[whole.faces].mean(axis=1)
            nearest = entries.col[own][cKDTree(centres[entries.row[own]]).query(middles)[1]]
            found |= {
                self.muscle_names[column - 1]: part_of(whole, np.flatnonzero(nearest == column))
                for column in columns
            }
        return found

    def muscle_number(self, name: str) -> int:
        """Return the row of one muscle in a pose's activations, one less than its column in S.

        Raises as :meth:`muscle_numbers`, and for a whole muscle of several parts.
        """
        first, *others = self.muscle_numbers(name)
        if others:
            parts = ", ".join(self.muscle_names[number] for number in (first, *others))
            message = f"{name} has the parts {parts}: name one, or take all by muscle_numbers"
            raise InputError("model.muscle", message)
        return int(first)

    def muscle_numbers(self, name: str) -> Ints:
        """Return the rows (k,) of all that a name means: a muscle, or all parts of a whole one.

        Raises :class:`InputError` (``model.muscle``) with names that are near.
        """
        found = find_muscles(name, self.muscle_names)
        if not found:
            told = tell_muscles(name, self.muscle_names)
            raise InputError("model.muscle", f"the model has no muscle {quote(name)!r}; {told}")
        return np.array(found)

    @property
    def anatomy(self) -> dict[str, str]:
        """Return the template as reports name it: its hash is that of the content, of no file."""
        kept = self.template
        return {"name": kept["name"], "version": kept["version"], "content_sha256": kept["sha256"]}

    @property
    def sha256(self) -> str:
        """Return the hash of all that the model holds."""
        return self.archive().sha256

    def save(self, path: Path | str) -> None:
        """Write the model as NPZ, without pickles."""
        self.archive().write(path)

    @classmethod
    def load(cls, path: Path | str) -> SubjectModel:
        """Read a model written by :meth:`save`, or that of a ``rig.npz``.

        Raises :class:`InputError` (``model.unreadable``, ``model.format``) if the file is not one.
        """
        path = Path(path)
        archive = Archive.read(path, "model", "a subject model", FORMAT)
        try:
            return cls.from_archive(archive.part("model") if "model" in archive.header else archive)
        except (KeyError, TypeError, ValueError) as error:
            message = f"{path.name} is not a subject model: {error}"
            raise InputError("model.unreadable", message, file=path.name) from error

    def archive(self) -> Archive:
        """Return all that the model holds, to be stored."""
        arrays: Arrays = {
            **{name: getattr(self, name) for name in ARRAYS},
            **csr_arrays("weights", self.weights),
            **csr_arrays("embedding", self.embedding),
            "skin_vertices": self.skin.vertices,
            "skin_faces": self.skin.faces,
            "jaw_origin": self.jaw.origin,
            "jaw_axes": self.jaw.axes,
        }
        for kind, surfaces in (("muscle", self.muscles), ("bone", self.bones)):
            for number, surface in enumerate(surfaces.values()):
                arrays[f"{kind}_{number}_vertices"] = surface.vertices
                arrays[f"{kind}_{number}_faces"] = surface.faces
        arrays |= {f"region_{name}": ids for name, ids in self.regions.items()}
        if self.fibres is not None:
            arrays["fibres"] = self.fibres
        if self.expressions is not None:
            arrays["expression_motions"] = self.expressions.motions
        if self.trained is not None:
            arrays["trained"] = self.trained
        header = {
            "format": FORMAT,
            "units": "mm",
            "muscle_names": self.muscle_names,
            "muscles": list(self.muscles),
            "bones": list(self.bones),
            "template": self.template,
            "mesh_source": self.mesh_source,
        }
        # models without these keep their hash
        if self.size_from != "scan":
            header["size_from"] = self.size_from
        if self.wholes:
            header["wholes"] = self.wholes
        if self.expressions is not None:
            header["expressions"] = self.expressions.names
        if self.jaw.tracks:
            header["condyle_tracks"] = asdict(self.jaw.tracks)
        return Archive(header, arrays)

    @classmethod
    def from_archive(cls, archive: Archive) -> SubjectModel:
        """Return the model that :meth:`archive` stored."""
        header = archive.header
        data = archive.arrays

        def surfaces(kind: str) -> dict[str, Surface]:
            return {
                name: Surface(data[f"{kind}_{number}_vertices"], data[f"{kind}_{number}_faces"])
                for number, name in enumerate(header[f"{kind}s"])
            }

        names = tuple(header["muscle_names"])
        tracks = header.get("condyle_tracks")
        shapes = header.get("expressions")
        expressions = shapes and Expressions(tuple(shapes), data["expression_motions"])
        return cls(
            **{name: data[name] for name in ARRAYS},
            muscle_names=names,
            weights=csr_from("weights", data, len(names) + 1),
            skin=Surface(data["skin_vertices"], data["skin_faces"]),
            embedding=csr_from("embedding", data, len(data["rest"])),
            jaw=JawFrame(data["jaw_origin"], data["jaw_axes"], tracks and CondyleTracks(**tracks)),
            muscles=surfaces("muscle"),
            bones=surfaces("bone"),
            regions=with_prefix(data, "region_"),
            template=header["template"],
            mesh_source=header.get("mesh_source", "mesher"),
            fibres=data.get("fibres"),
            size_from=header.get("size_from", "scan"),
            wholes=tuple(header.get("wholes", ())),
            expressions=expressions,
            trained=data.get("trained"),
        )


def weights_hash(S: sp.csr_array) -> str:
    """Return the sha256 of S (n, m + 1)."""
    digest = hashlib.sha256()
    for array, kind in ((S.indptr, "<i8"), (S.indices, "<i8"), (S.data, "<f8")):
        digest.update(np.ascontiguousarray(array, dtype=kind).tobytes())
    return digest.hexdigest()


def identity(model: SubjectModel, S: sp.csr_array) -> dict[str, str]:
    """Return the hashes of a model and its S, by which files know whom they are of."""
    return {"model": model.sha256, "weights": weights_hash(S)}
