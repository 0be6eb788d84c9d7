"""The template anatomy: skull, jaw and muscles inside one skin topology.

A registered scan of any person has the template's skin topology (same vertex count and order), so
the template's anatomy can be carried into that person by correspondence. A template is stored as
one NPZ file without pickles.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from pathlib import Path

import numpy as np

from solver.anatomy.depths import Depth
from solver.anatomy.shapes import ShapeBasis
from solver.anatomy.template_arrays import check_arrays
from solver.anatomy.template_mesh import TemplateMesh
from solver.archive import Archive, Arrays, with_prefix
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface

FORMAT = 1


@dataclass(frozen=True)
class Muscle:
    """One muscle: a closed-enough ``surface`` in mm and its main ``fibre`` direction, unit (3,).

    ``fibre`` points from origin (bone) to insertion (skin); ``origin`` and ``insertion`` (3,) are
    the centres of the two attachments, in mm. The fibres of a ``ring`` run around an opening.
    """

    name: str
    surface: Surface
    fibre: Floats
    origin: Floats
    insertion: Floats
    ring: bool = False


@dataclass(frozen=True)
class Template:
    """Template anatomy in mm; x to the subject's left, y up, z forward.

    skin
        The whole registered-scan topology at rest: every vertex a scan must have.
    flesh_faces
        (k,) numbers of skin faces that bound the flesh (face, neck, lips, lining of mouth and
        eyelids), as opposed to eyeballs, teeth, tongue and lashes.
    face_vertices
        (k,) skin vertices that are fitted and on which errors are reported (the face skin).
    attached_cranium, attached_mandible
        Skin vertices that move rigidly with a bone: eyes, upper teeth, back of the head; lower
        teeth, tongue.
    parting
        (n, 3) displacement of the skin that parts the closed lips (and lids) enough to mesh them.
    cranium, mandible
        Watertight bone surfaces that bound the flesh from inside.
    condyles
        (2, 3) centres of the left and right mandibular condyle.
    landmarks
        Name -> skin vertex.
    regions
        Name -> skin vertices, for reports by region.
    back_z, bottom_y
        Planes behind and below which there is no flesh: its tets end there, held fixed.
    shapes
        How the skin varies over persons and expressions, where that is known; registration fits
        it to a scan before it fits the vertices.
    licence
        What the template may be used for, by its sources; empty where nobody said.
    depths
        Soft-tissue depths that the bones were placed by.
    mesh
        The tetrahedra that every person's model shares, where they have been made.
    """

    name: str
    version: str
    source: str
    skin: Surface
    flesh_faces: Ints
    face_vertices: Ints
    attached_cranium: Ints
    attached_mandible: Ints
    parting: Floats
    cranium: Surface
    mandible: Surface
    muscles: tuple[Muscle, ...]
    condyles: Floats
    back_z: float
    bottom_y: float
    landmarks: dict[str, int] = field(default_factory=dict)
    regions: dict[str, Ints] = field(default_factory=dict)
    shapes: ShapeBasis | None = None
    licence: str = ""
    depths: tuple[Depth, ...] = ()
    mesh: TemplateMesh | None = None

    @property
    def parted(self) -> Surface:
        """Return the skin with the lips parted."""
        return self.skin.moved(self.skin.vertices + self.parting)

    @property
    def sha256(self) -> str:
        """Return the hash of all that the template holds."""
        return self._archive().sha256

    def save(self, path: Path) -> str:
        """Write the template as NPZ and return its :attr:`sha256`."""
        archive = self._archive()
        archive.write(path)
        return archive.sha256

    @classmethod
    def load(cls, path: Path) -> Template:
        """Read a template written by :meth:`save`.

        Raises :class:`InputError`: ``template.unreadable`` or ``template.format`` if the file is
        not one, else as :func:`solver.anatomy.template_arrays.check_arrays`.
        """
        archive = Archive.read(path, "template", "a template", FORMAT)
        try:
            template = cls._from_archive(archive)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                "template.unreadable", f"{path.name} is not a template: {error}", file=path.name
            ) from error
        check_arrays(template, path.name)
        return template

    def _archive(self) -> Archive:
        arrays: Arrays = {
            "skin_vertices": self.skin.vertices,
            "skin_faces": self.skin.faces,
            "flesh_faces": self.flesh_faces,
            "face_vertices": self.face_vertices,
            "attached_cranium": self.attached_cranium,
            "attached_mandible": self.attached_mandible,
            "parting": self.parting,
            "cranium_vertices": self.cranium.vertices,
            "cranium_faces": self.cranium.faces,
            "mandible_vertices": self.mandible.vertices,
            "mandible_faces": self.mandible.faces,
            "condyles": self.condyles,
            "planes": np.array([self.back_z, self.bottom_y]),
        }
        for number, muscle in enumerate(self.muscles):
            arrays[f"muscle_{number}_vertices"] = muscle.surface.vertices
            arrays[f"muscle_{number}_faces"] = muscle.surface.faces
            arrays[f"muscle_{number}_axis"] = np.stack(
                [muscle.fibre, muscle.origin, muscle.insertion]
            )
        arrays |= {f"region_{name}": ids for name, ids in self.regions.items()}
        if self.shapes is not None:
            arrays["shapes_identity"] = self.shapes.identity
            arrays["shapes_expressions"] = self.shapes.expressions
        if self.mesh is not None:
            arrays |= {f"mesh_{name}": array for name, array in self.mesh.arrays().items()}
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
        return Archive(header, arrays)

    @classmethod
    def _from_archive(cls, archive: Archive) -> Template:
        header, data = archive.header, archive.arrays
        muscles = []
        for number, name in enumerate(header["muscles"]):
            fibre, origin, insertion = data[f"muscle_{number}_axis"]
            surface = Surface(data[f"muscle_{number}_vertices"], data[f"muscle_{number}_faces"])
            ring = name in header.get("rings", ())
            muscles.append(Muscle(name, surface, fibre, origin, insertion, ring))
        shapes = None
        if "shapes_identity" in data:
            shapes = ShapeBasis(
                data["shapes_identity"],
                data["shapes_expressions"],
                tuple(header["expression_names"]),
            )
        mesh = with_prefix(data, "mesh_")
        back_z, bottom_y = data["planes"]
        return cls(
            name=header["name"],
            version=header["version"],
            source=header["source"],
            skin=Surface(data["skin_vertices"], data["skin_faces"]),
            flesh_faces=data["flesh_faces"],
            face_vertices=data["face_vertices"],
            attached_cranium=data["attached_cranium"],
            attached_mandible=data["attached_mandible"],
            parting=data["parting"],
            cranium=Surface(data["cranium_vertices"], data["cranium_faces"]),
            mandible=Surface(data["mandible_vertices"], data["mandible_faces"]),
            muscles=tuple(muscles),
            condyles=data["condyles"],
            back_z=float(back_z),
            bottom_y=float(bottom_y),
            landmarks=dict(header["landmarks"]),
            regions=with_prefix(data, "region_"),
            shapes=shapes,
            licence=header.get("licence", ""),
            depths=tuple(Depth(*row) for row in header.get("depths", ())),
            mesh=TemplateMesh.from_arrays(mesh, len(muscles)) if mesh else None,
        )
