"""BodyParts3D as DBCLS publishes it: release 3.0, one OBJ an organ, named by its FMA id.

``data/bodyparts3d_parts.csv`` says which of its organs the face needs and what they are. Release
4.0 (``FJ1234.obj`` with element lists) has no muscles of facial expression or mastication, and
another pose; it can not be used.
"""

from __future__ import annotations

import csv
from importlib import resources
from pathlib import Path

from solver.anatomy.public_files import PublicFile, obj_mesh, public_files
from solver.errors import InputError
from solver.surface import Surface


def public_parts(folder: Path) -> list[tuple[str, str, Surface]]:
    """Return (name, category, mesh) of the organs that the face needs, in BodyParts3D's axes (mm).

    ``folder`` holds ``FMA*.obj`` at any depth, or the archive ``BodyParts3D_3.0_obj_99.zip``.

    Raises
    ------
    InputError
        ``anatomy.index`` if there is no such mesh, ``anatomy.release`` for release 4.0,
        ``anatomy.part`` if an organ is missing, ``download.*`` for a file that can not be read.
    """
    files = {file.name: file for file in public_files(folder, ".obj")}
    if not any(name.startswith(("FMA", "FJ")) for name in files):
        raise InputError(
            "anatomy.index",
            f"there is neither index.csv nor an FMA*.obj of BodyParts3D in {folder}",
            file=str(folder),
        )
    if not any(name.startswith("FMA") for name in files):
        raise InputError(
            "anatomy.release",
            f"{folder} holds BodyParts3D 4.0, which has no muscles of the face; release 3.0 has",
            file=str(folder),
        )
    with resources.files("solver.anatomy.data").joinpath("bodyparts3d_parts.csv").open() as table:
        return [
            (row["name"], row["category"], _surface(files, row["fma_id"], row["name"], folder))
            for row in csv.DictReader(table)
        ]


def _surface(files: dict[str, PublicFile], fma_id: str, name: str, folder: Path) -> Surface:
    file = files.get(f"{fma_id}.obj")
    if file is None:
        raise InputError(
            "anatomy.part",
            f"{folder} lacks {fma_id}.obj ({name}) of BodyParts3D 3.0",
            file=f"{fma_id}.obj",
            part=name,
        )
    vertices, polygons = obj_mesh(file)
    if (polygons[:, 3] >= 0).any():
        raise InputError("download.mesh", f"{file} has faces of four corners", file=str(file))
    return Surface(vertices, polygons[:, :3])
