"""ICT-FaceKit as USC ICT publishes it: the folder ``FaceXModel`` of OBJ meshes, in cm.

``generic_neutral_mesh.obj`` is the average head; ``identity000.obj`` ... are whole heads one
standard deviation of a component away from it, and every other OBJ is one expression at its full
strength. A shape is the difference to the neutral.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from solver.anatomy.public_files import PublicFile, obj_mesh, obj_vertices, public_files
from solver.errors import InputError
from solver.surface import Floats

NEUTRAL = "generic_neutral_mesh"
_IDENTITY = re.compile(r"identity\d{3}")


def public_facekit(folder: Path) -> dict[str, np.ndarray]:
    """Return the arrays of the published model under the names of ``ict_facekit.npz``, in cm.

    ``V`` (n, 3), ``quads`` (f, 4), ``E`` (e, n, 3) with names ``ex`` (e), ``I`` (k, n, 3).
    ``folder`` holds the OBJs at any depth, or an archive of the repository.

    Raises
    ------
    InputError
        ``faces.unreadable`` if there is no neutral, ``faces.topology`` if a shape has another
        number of vertices, ``download.*`` for a file that can not be read.
    """
    files = _of_one_folder(folder)
    neutral, quads = obj_mesh(files.pop(NEUTRAL))
    identities = sorted(name for name in files if _IDENTITY.fullmatch(name))
    expressions = sorted(files.keys() - set(identities))
    return {
        "V": neutral,
        "quads": quads,
        "E": _shapes([files[name] for name in expressions], neutral),
        "ex": np.array(expressions),
        "I": _shapes([files[name] for name in identities], neutral),
    }


def _of_one_folder(folder: Path) -> dict[str, PublicFile]:
    """Return name -> OBJ of those beside the neutral: the repository has other meshes elsewhere."""
    files = public_files(folder, ".obj")
    home = next((file.folder for file in files if file.name == f"{NEUTRAL}.obj"), None)
    if home is None:
        raise InputError(
            "faces.unreadable",
            f"{folder} has neither ict_facekit.npz nor ICT-FaceKit's {NEUTRAL}.obj",
            file=str(folder),
        )
    return {file.name.removesuffix(".obj"): file for file in files if file.folder == home}


def _shapes(files: list[PublicFile], neutral: Floats) -> np.ndarray:
    shapes = np.empty((len(files), *neutral.shape), dtype=np.float32)
    for shape, file in zip(shapes, files, strict=True):
        vertices = obj_vertices(file)
        if len(vertices) != len(neutral):
            raise InputError(
                "faces.topology",
                f"{file} has {len(vertices)} vertices, the neutral has {len(neutral)}",
                file=str(file),
                expected=len(neutral),
                found=len(vertices),
            )
        shape[:] = vertices - neutral
    return shapes
