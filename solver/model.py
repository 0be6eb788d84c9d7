"""The subject model: one person's flesh as tetrahedra, with bones, muscles and skin embedding.

It is what ``build_model`` makes, what every fit reads, and is stored as one NPZ file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import scipy.sparse as sp

from solver.errors import InputError
from solver.storage import Archive, Arrays, csr_arrays, csr_from, with_prefix
from solver.surface import Floats, Ints, Surface

FORMAT = 1  # of the file
# fields of a model that are arrays, stored as they are
ARRAYS = (
    "rest",
    "tets",
    "cranium",
    "mandible",
    "cut",
    "sliding",
    "embedded",
    "offset",
    "attached_mandible",
    "face",
)


@dataclass(frozen=True)
class JawFrame:
    """The mandible's five degrees of freedom b (ARCHITECTURE.md, the equations: jaw).

    ``origin`` (3,) lies half way between the condyles; ``axes`` (3, 3) has rows: the unit vector
    through the condyles (to the subject's left), the vertical axis, and their cross product.
    b = (rotation about row 0, rotation about row 1, translation along rows 0, 1, 2), rad and mm.
    """

    origin: Floats
    axes: Floats


@dataclass(frozen=True)
class SubjectModel:
    """Tetrahedral face of one person; mm, x to the subject's left, y up, z forward.

    rest
        (p, 3) rest vertices.
    tets
        (n, 4) vertex numbers, every rest volume positive.
    cranium, mandible, cut, sliding
        Vertex numbers: fixed to the cranium, moving with the mandible, fixed on the cut planes,
        and free to slide along the cranium (on the plane through their rest position, see
        :mod:`solver.mechanics.terms`).
    muscle_names
        The m muscles. Column 0 of S is passive flesh, column j the muscle ``muscle_names[j - 1]``.
    weights
        (n, m + 1) CSR: initial S. Its pattern is the candidates (passive column and the muscles
        within 10 mm of a tet; explicit zeros are kept), rows sum to one.
    skin
        The whole scan topology in the subject's neutral pose.
    embedded
        (e,) skin vertices that follow the flesh; ``embedding`` (e, p) CSR gives their position
        as embedding @ x + offset, with barycentric rows; ``offset`` is (e, 3).
    attached_mandible
        Skin vertices that move rigidly with the mandible. Every skin vertex that is neither
        embedded nor listed here stays with the cranium.
    face
        (k,) skin vertices on which targets and errors are taken; a subset of ``embedded``.
    jaw
        The mandible's frame.
    muscles, bones
        Name -> surface in the subject, for pictures and exports.
    regions
        Name -> skin vertices, for reports.
    template
        ``name``, ``version`` and ``sha256`` of the template that was used.
    mesh_source
        ``transport`` if the tets are the template's, ``mesher`` if they were made for this person,
        then with the reason if transport was tried.
    fibres
        (nnz, 3) unit fibre directions, one for each stored entry of ``weights``, from origin to
        insertion or around a ring, and zero in the passive column. None in models made before
        fibres were.
    """

    rest: Floats
    tets: Ints
    cranium: Ints
    mandible: Ints
    cut: Ints
    sliding: Ints
    muscle_names: tuple[str, ...]
    weights: sp.csr_array
    skin: Surface
    embedded: Ints
    embedding: sp.csr_array
    offset: Floats
    attached_mandible: Ints
    face: Ints
    jaw: JawFrame
    muscles: dict[str, Surface]
    bones: dict[str, Surface]
    regions: dict[str, Ints]
    template: dict[str, str]
    mesh_source: str = "mesher"
    fibres: Floats | None = None

    @property
    def muscle_count(self) -> int:
        """Return m, the number of muscles (the passive column not counted)."""
        return len(self.muscle_names)

    @property
    def anatomy(self) -> dict[str, str]:
        """Return the template as reports name it: its hash is that of the content, of no file."""
        kept = self.template
        return {"name": kept["name"], "version": kept["version"], "content_sha256": kept["sha256"]}

    @property
    def sha256(self) -> str:
        """Return the hash of all that the model holds."""
        return self.archive().sha256

    def save(self, path: Path) -> None:
        """Write the model as NPZ, without pickles."""
        self.archive().write(path)

    @classmethod
    def load(cls, path: Path) -> SubjectModel:
        """Read a model written by :meth:`save`, or that of a ``rig.npz``.

        Raises :class:`InputError` (``model.unreadable``, ``model.format``) if the file is not one.
        """
        archive = Archive.read(path, "model", "a subject model", FORMAT)
        try:
            return cls.from_archive(archive.part("model") if "model" in archive.header else archive)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                "model.unreadable", f"{path.name} is not a subject model: {error}", file=path.name
            ) from error

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
        header = {
            "format": FORMAT,
            "units": "mm",
            "muscle_names": self.muscle_names,
            "muscles": list(self.muscles),
            "bones": list(self.bones),
            "template": self.template,
            "mesh_source": self.mesh_source,
        }
        return Archive(header, arrays)

    @classmethod
    def from_archive(cls, archive: Archive) -> SubjectModel:
        """Return the model that :meth:`archive` stored."""
        header, data = archive.header, archive.arrays

        def surfaces(kind: str) -> dict[str, Surface]:
            return {
                name: Surface(data[f"{kind}_{number}_vertices"], data[f"{kind}_{number}_faces"])
                for number, name in enumerate(header[f"{kind}s"])
            }

        names = tuple(header["muscle_names"])
        return cls(
            **{name: data[name] for name in ARRAYS},
            muscle_names=names,
            weights=csr_from("weights", data, len(names) + 1),
            skin=Surface(data["skin_vertices"], data["skin_faces"]),
            embedding=csr_from("embedding", data, len(data["rest"])),
            jaw=JawFrame(data["jaw_origin"], data["jaw_axes"]),
            muscles=surfaces("muscle"),
            bones=surfaces("bone"),
            regions=with_prefix(data, "region_"),
            template=header["template"],
            mesh_source=header.get("mesh_source", "mesher"),
            fibres=data.get("fibres"),
        )
