"""The subject model: one person's flesh as tetrahedra, with bones, muscles and skin embedding.

It is what ``build_model`` makes, what every fit reads, and is stored as one NPZ file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.surface import Floats, Ints, Surface

FORMAT = 1


@dataclass(frozen=True)
class JawFrame:
    """The mandible's five degrees of freedom b (SYSTEM: jaw).

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
        and free to slide along the cranium (held like ``cranium`` until sliding is solved).
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
        Name and version of the template that was used.
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

    @property
    def muscle_count(self) -> int:
        """Return m, the number of muscles (the passive column not counted)."""
        return len(self.muscle_names)

    def save(self, path: Path) -> None:
        """Write the model as NPZ, without pickles."""
        arrays: dict[str, np.ndarray] = {
            "rest": self.rest,
            "tets": self.tets,
            "cranium": self.cranium,
            "mandible": self.mandible,
            "cut": self.cut,
            "sliding": self.sliding,
            "weights_data": self.weights.data,
            "weights_indices": self.weights.indices,
            "weights_indptr": self.weights.indptr,
            "skin_vertices": self.skin.vertices,
            "skin_faces": self.skin.faces,
            "embedded": self.embedded,
            "embedding_data": self.embedding.data,
            "embedding_indices": self.embedding.indices,
            "embedding_indptr": self.embedding.indptr,
            "offset": self.offset,
            "attached_mandible": self.attached_mandible,
            "face": self.face,
            "jaw_origin": self.jaw.origin,
            "jaw_axes": self.jaw.axes,
        }
        for kind, surfaces in (("muscle", self.muscles), ("bone", self.bones)):
            for number, surface in enumerate(surfaces.values()):
                arrays[f"{kind}_{number}_vertices"] = surface.vertices
                arrays[f"{kind}_{number}_faces"] = surface.faces
        for name, ids in self.regions.items():
            arrays[f"region_{name}"] = ids
        header = {
            "format": FORMAT,
            "units": "mm",
            "muscle_names": self.muscle_names,
            "muscles": list(self.muscles),
            "bones": list(self.bones),
            "template": self.template,
        }
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with path.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> SubjectModel:
        """Read a model written by :meth:`save`.

        Raises :class:`InputError` (``model.unreadable``, ``model.format``) if the file is not one.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                header = json.loads(bytes(data["header"]))
                if header["format"] != FORMAT:
                    raise InputError(
                        "model.format",
                        f"{path.name} has model format {header['format']}, not {FORMAT}",
                        file=path.name,
                    )
                return cls._from_arrays(header, dict(data))
        except InputError:
            raise
        except (OSError, KeyError, TypeError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(
                "model.unreadable", f"{path.name} is not a subject model: {error}", file=path.name
            ) from error

    @classmethod
    def _from_arrays(cls, header: dict[str, Any], data: dict[str, np.ndarray]) -> SubjectModel:
        def csr(name: str, columns: int) -> sp.csr_array:
            indptr = data[f"{name}_indptr"]
            parts = (data[f"{name}_data"], data[f"{name}_indices"], indptr)
            return sp.csr_array(parts, shape=(len(indptr) - 1, columns))

        def surfaces(kind: str) -> dict[str, Surface]:
            return {
                name: Surface(data[f"{kind}_{number}_vertices"], data[f"{kind}_{number}_faces"])
                for number, name in enumerate(header[f"{kind}s"])
            }

        names = tuple(header["muscle_names"])
        return cls(
            rest=data["rest"],
            tets=data["tets"],
            cranium=data["cranium"],
            mandible=data["mandible"],
            cut=data["cut"],
            sliding=data["sliding"],
            muscle_names=names,
            weights=csr("weights", len(names) + 1),
            skin=Surface(data["skin_vertices"], data["skin_faces"]),
            embedded=data["embedded"],
            embedding=csr("embedding", len(data["rest"])),
            offset=data["offset"],
            attached_mandible=data["attached_mandible"],
            face=data["face"],
            jaw=JawFrame(data["jaw_origin"], data["jaw_axes"]),
            muscles=surfaces("muscle"),
            bones=surfaces("bone"),
            regions={
                key.removeprefix("region_"): ids
                for key, ids in data.items()
                if key.startswith("region_")
            },
            template=header["template"],
        )
