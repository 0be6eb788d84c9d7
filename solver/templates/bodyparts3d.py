"""Read BodyParts3D (DBCLS, CC BY 4.0): its release 3.0, or ``index.csv`` and one PLY a part.

BodyParts3D is in mm with x to the subject's left, -y forward and z up; everything here is returned
with y up and z forward.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from solver.anatomy.data import read_table
from solver.anatomy.muscle_weights import muscle_ends, with_axis
from solver.anatomy.template import Compartments, Muscle
from solver.anatomy.warp import MIRROR
from solver.errors import InputError
from solver.surface import Floats, Surface, join_surfaces, part_of
from solver.templates.tables import PublicFile, file_fault, obj_mesh, public_files

# The download as DBCLS publishes it: release 3.0, one OBJ an organ, named by its FMA id. Release
# 4.0 (``FJ1234.obj`` with element lists) has no muscles of the face and another pose.


@dataclass(frozen=True)
class AnatomicalPart:
    """One anatomical part, in mm with y up, and its category."""

    category: str
    surface: Surface


def public_parts(folder: Path) -> dict[str, AnatomicalPart]:
    """Return name -> the organs that the face needs, by ``data/bodyparts3d_parts.csv``.

    ``folder`` holds ``FMA*.obj`` at any depth, or the archive ``BodyParts3D_3.0_obj_99.zip``.

    Raises :class:`InputError`: ``anatomy.index`` if there is no such mesh, ``anatomy.release`` for
    release 4.0, ``anatomy.part`` if an organ is missing, ``download.*`` for an unreadable file.
    """
    files = {file.name: file for file in public_files(folder, ".obj")}
    if not any(name.startswith(("FMA", "FJ")) for name in files):
        reason = f"there is neither index.csv nor an FMA*.obj of BodyParts3D in {folder}"
        raise file_fault("anatomy.index", reason, folder)
    if not any(name.startswith("FMA") for name in files):
        reason = "holds BodyParts3D 4.0, which has no muscles of the face; release 3.0 has"
        raise file_fault("anatomy.release", f"{folder} {reason}", folder)
    return {
        row["name"]: AnatomicalPart(
            row["category"], _surface(files, row["fma_id"], row["name"], folder)
        )
        for row in read_table("bodyparts3d_parts")
    }


def _surface(files: dict[str, PublicFile], fma_id: str, name: str, folder: Path) -> Surface:
    file = files.get(f"{fma_id}.obj")
    if file is None:
        reason = f"{folder} lacks {fma_id}.obj ({name}) of BodyParts3D 3.0"
        raise file_fault("anatomy.part", reason, f"{fma_id}.obj", part=name)
    vertices, polygons = obj_mesh(file)
    if (polygons[:, 3] >= 0).any():
        raise file_fault("download.mesh", f"{file} has faces of four corners", file)
    return Surface(to_subject_axes(vertices), polygons[:, :3])


MIDDLE_X = -0.65  # mm, the plane of symmetry
RINGS = ("orbital", "palpebral")  # parts of orbicularis oculi, the larger first
_COLUMNS = {"fma_id", "category", "name"}
# Chewing muscles of the face's outer layer; the pterygoids lie inside the jaw and the occipital
# belly and temporoparietalis behind the flesh.
_CHEWING = ("masseter", "temporalis")
_BEHIND = ("occipitalis", "temporoparietalis")


def to_subject_axes(points: Floats) -> Floats:
    """Turn BodyParts3D's (x, -y forward, z up) into (x, y up, z forward)."""
    return np.column_stack([points[:, 0], points[:, 2], -points[:, 1]])


def read_parts(folder: Path) -> dict[str, AnatomicalPart]:
    """Return the parts by name: the meshes of an ``index.csv``, else those of the download.

    Raises :class:`InputError`: ``anatomy.index`` if there is neither or the index lacks a column,
    ``anatomy.mesh`` if a mesh it lists is missing or unreadable, or as :func:`public_parts`.
    """
    index = folder / "index.csv"
    parts = _read_index(index) if index.is_file() else public_parts(folder)
    for side in ("left", "right"):
        _name_eye_rings(parts, side)
    return parts


def _read_index(index: Path) -> dict[str, AnatomicalPart]:
    with index.open(newline="") as stream:
        reader = csv.DictReader(stream)
        missing = _COLUMNS - set(reader.fieldnames or ())
        if missing:
            raise file_fault("anatomy.index", f"{index} lacks the columns {sorted(missing)}", index)
        return {
            row["name"]: AnatomicalPart(
                row["category"], _read_mesh(index.with_name(f"{row['fma_id']}.ply"))
            )
            for row in reader
        }


def _name_eye_rings(parts: dict[str, AnatomicalPart], side: str) -> None:
    """Give the larger eye ring the name of the orbital part: BodyParts3D 3.0 swaps the two."""
    names = [f"{part} part of {side} orbicularis oculi" for part in RINGS]
    if parts.keys() >= set(names):
        rings = [parts[name] for name in names]
        rings.sort(key=lambda ring: -float(np.ptp(ring.surface.vertices[:, 1])))
        parts.update(zip(names, rings, strict=True))


def _read_mesh(path: Path) -> Surface:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (OSError, ValueError, IndexError) as error:
        raise file_fault("anatomy.mesh", f"{path.name} cannot be read: {error}", path) from error
    vertices = np.asarray(mesh.vertices, float)
    faces = np.asarray(mesh.faces, np.int64)
    return Surface(to_subject_axes(vertices), faces)


def muscle_names(parts: dict[str, AnatomicalPart]) -> list[str]:
    """Return the muscles that move the face: the facial ones, then masseter and temporalis."""
    facial = [
        n for n, p in parts.items() if p.category == "facial_muscle" and not n.endswith(_BEHIND)
    ]
    chewing = [
        n for n, p in parts.items() if p.category == "mastication_muscle" and n.endswith(_CHEWING)
    ]
    return sorted(facial) + sorted(chewing)


def with_table_axis(name: str, surface: Surface, skull: Floats) -> Muscle:
    """Return a muscle with axis and compartments of ``data/bodyparts3d_muscles.csv``.

    They are from anatomy texts. One that is not in the table gets an axis as by :func:`with_axis`.
    """
    words = name.split()
    plain = " ".join(word for word in words if word not in ("left", "right"))
    row = next((row for row in read_table("bodyparts3d_muscles") if row["muscle"] == plain), None)
    if row is None:
        return with_axis(name, surface, skull)
    axis = np.array([float(row[key]) for key in "xyz"])
    axis = axis / np.linalg.norm(axis) * (MIRROR if "right" in words else 1.0)
    origin, insertion = muscle_ends(surface, axis)
    compartments = Compartments.read(row["cut"], row["compartments"])
    return Muscle(name, surface, axis, origin, insertion, row["ring"] == "yes", compartments)


def part_surface(parts: dict[str, AnatomicalPart], name: str) -> Surface:
    """Return a part's surface; raises :class:`InputError` (``anatomy.part``) if it is missing."""
    if name not in parts:
        raise InputError("anatomy.part", f"the anatomy has no part named '{name}'", part=name)
    return parts[name].surface


def reflect(points: Floats) -> Floats:
    """Return points (..., 3) on the other side of the mid-plane."""
    return np.asarray(points * MIRROR + [2 * MIDDLE_X, 0.0, 0.0])


def symmetric(parts: dict[str, AnatomicalPart]) -> dict[str, AnatomicalPart]:
    """Return parts of the same names that are the left half of the anatomy and its mirror image.

    The man is nearly so (muscles to 0.5 mm), and a symmetric head needs it.
    """
    result = {}
    for name, part in parts.items():
        left = parts.get(name.replace("right", "left"))
        surface = part.surface
        if "right" in name and left is not None:
            surface = _mirror_image(left.surface)
        elif "left" not in name:  # cut at the mid-plane
            on_left = (surface.vertices[surface.faces, 0] > MIDDLE_X).any(axis=1)
            half = part_of(surface, np.flatnonzero(on_left))
            half = half.with_vertices(np.maximum(half.vertices, [MIDDLE_X, -np.inf, -np.inf]))
            surface = join_surfaces([half, _mirror_image(half)])
        result[name] = AnatomicalPart(part.category, surface)
    return result


def _mirror_image(surface: Surface) -> Surface:
    return surface.with_vertices(reflect(surface.vertices)).flipped()


def merge_parts(parts: dict[str, AnatomicalPart], *categories: str) -> Surface:
    """Return all parts of some categories as one surface."""
    return join_surfaces([part.surface for part in parts.values() if part.category in categories])
