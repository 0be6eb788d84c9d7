"""Reading a raw scan: any mesh or point cloud, faithfully, in any of five formats."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.meshio.glb import MM_PER_METRE, read_glb, read_raw_glb
from solver.meshio.obj import read_obj, read_raw_obj
from solver.meshio.plausible import check_alignment, check_scale, check_vertex_order
from solver.meshio.ply import read_ply, read_raw_ply, write_ply
from solver.meshio.rows import (
    Mesh,
    check_finite,
    check_suffix,
    read_content,
    wrong_vertex_count,
)
from solver.meshio.stl import (
    FACET,
    HEADER_BYTES,
    read_raw_stl,
    read_stl,
)
from solver.meshio.xyz import read_xyz
from solver.surface import Floats, Ints, Surface

# What a file holds, whatever its suffix says.


OTHERS = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a ZIP archive",
    b"Rar!": "a RAR archive",
    b"7z\xbc\xaf": "a 7-Zip archive",
    b"\x1f\x8b": "a gzip archive",
    b"Kaydara FBX": "an FBX scene",
    b"BLENDER": "a Blender file",
    b"<!DOCTYPE": "a web page",
    b"<html": "a web page",
    b"\x93NUMPY": "a NumPy array",
    b"DICM": "a DICOM image",
}
HEAD_BYTES = 65536
OBJ_LINE = re.compile(rb"^(v|vn|vt|f|g|o|s|mtllib|usemtl)[ \t]+\S", re.MULTILINE)
POINT_LINE = re.compile(rb"^[ \t]*[-+\d.][-+\d.eE]*([ \t,;]+[-+\w.]+){2,}[ \t\r]*$", re.MULTILINE)


def sniff(file: str, content: bytes, suffix_format: str) -> str:
    """Return the format that ``content`` holds; in doubt the one its suffix says.

    Raises :class:`InputError` (``scan.wrong_extension``) if it is known to be no scan at all.
    """
    head = content[:HEAD_BYTES]
    found = next((what for magic, what in OTHERS.items() if head.startswith(magic)), None)
    if found is not None:
        raise InputError(
            "scan.wrong_extension",
            f"{file} is {found}, not a scan in {suffix_format.upper()} format",
            file=file,
            expected=suffix_format,
            found=found,
        )
    if re.match(rb"ply\r?\n", head):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if b"\0" in head:
        facets = int.from_bytes(content[80:84], "little")
        is_stl = len(content) == HEADER_BYTES + facets * FACET.itemsize
        return "stl" if is_stl else suffix_format
    if re.match(rb"\s*solid\b.*\s+(facet|endsolid)\b", head):
        return "stl"
    if OBJ_LINE.search(head):
        return "obj"
    return "xyz" if POINT_LINE.search(head) else suffix_format


READERS: dict[str, Callable[[str, bytes], Mesh]] = {
    "obj": read_raw_obj,
    "ply": read_raw_ply,
    "stl": read_raw_stl,
    "glb": read_raw_glb,
    "xyz": read_xyz,
}
POINT_SUFFIXES = ("xyz", "pts", "asc", "csv", "txt", "xyzn", "xyzrgb")
FORMATS = {
    **{f".{name}": name for name in READERS},
    **{f".{suffix}": "xyz" for suffix in POINT_SUFFIXES},
}
"""Suffix -> format."""
MAX_BYTES = 512 * 2**20
MAX_VERTICES = 8_000_000


@dataclass(frozen=True)
class RawScan:
    """A scan as its file holds it: unit, axes and faults are the file's.

    file
        The file's name, for messages.
    vertices
        (n, 3) in the file's unit; not-a-number and duplicate vertices are kept.
    faces
        (f, 3) triangles; (0, 3) for a point cloud.
    normals, colours
        (n, 3) as stored, and (n, 3) in [0, 1]; None where the file has none.
    mm_per_unit
        What the format declares (glTF: 1000), None where it declares nothing.
    format, suffix_format
        What the file holds and what its suffix says: ``obj``, ``ply``, ``stl``, ``glb``, ``xyz``.
    empty_groups
        Names of groups, objects or parts without a face.
    """

    file: str
    vertices: Floats
    faces: Ints
    normals: Floats | None
    colours: Floats | None
    mm_per_unit: float | None
    format: str
    suffix_format: str
    empty_groups: tuple[str, ...] = ()


def read_raw(path: Path) -> RawScan:
    """Read a raw scan: OBJ, PLY, STL, GLB or a point cloud as text.

    The content decides what it is read as: a wrong suffix shows in ``suffix_format``. Raises
    :class:`InputError`: ``scan.format`` (unknown suffix or an unsupported form of a format),
    ``scan.wrong_extension`` (no scan at all), ``scan.too_large``, ``scan.empty``,
    ``scan.unreadable`` or ``scan.truncated``, each with ``file`` and, where it helps, ``line``.
    """
    file, suffix = path.name, check_suffix(path, FORMATS)
    content = read_content(path, MAX_BYTES, "a raw scan")
    held = sniff(file, content, FORMATS[suffix])
    mesh = READERS[held](file, content)
    if len(mesh.vertices) > MAX_VERTICES:
        raise InputError(
            "scan.too_large",
            f"{file} has {len(mesh.vertices)} vertices; a raw scan has at most {MAX_VERTICES}",
            file=file,
            expected=MAX_VERTICES,
            found=len(mesh.vertices),
        )
    return RawScan(
        file=file,
        vertices=mesh.vertices,
        faces=mesh.faces.astype(np.int64, copy=False),
        normals=mesh.normals,
        colours=mesh.colours,
        mm_per_unit=MM_PER_METRE if held == "glb" else None,
        format=held,
        suffix_format=FORMATS[suffix],
        empty_groups=mesh.empty_groups,
    )


# A scan in the template's topology, and how far each of its vertices can be trusted.


CONFIDENCE = "confidence"
"""The PLY property of the vertices."""


@dataclass(frozen=True)
class RegisteredScan:
    """``vertices`` (n, 3) in mm and their ``confidence`` (n,) in [0, 1], 0 where nothing was seen.

    A file that says nothing about confidence is trusted everywhere.
    """

    vertices: Floats
    confidence: Floats


def write_registered(path: Path, surface: Surface, confidence: Floats) -> None:
    """Write a registered scan as PLY; :func:`solver.meshio.read.read_registered` reads it."""
    write_ply(path, surface, {CONFIDENCE: confidence})


# Reading a registered scan: a mesh with the template's vertices, in the template's order.


REGISTERED_FORMATS = (".obj", ".ply", ".stl", ".glb")
MAX_REGISTERED_BYTES = 256 * 2**20


def read_registered(
    path: Path, faces: Ints, vertex_count: int, *, neutral: Floats | None = None
) -> RegisteredScan:
    """Return the vertices (vertex_count, 3) of a registered scan, in mm, and their confidence.

    The format follows the file's suffix. OBJ, PLY and STL carry no unit and must be in mm; GLB is
    in metres, as glTF demands. ``faces`` (f, 3) are the template's; an expression is checked
    against ``neutral`` (vertex_count, 3). Only PLY carries a confidence, in the vertices' property
    of that name; elsewhere it is 1.

    Raises :class:`InputError`: ``scan.format``, ``scan.too_large``, ``scan.empty``,
    ``scan.unreadable``, ``scan.truncated``, ``scan.nan``, ``scan.vertex_count``,
    ``scan.vertex_order``, ``scan.confidence``, ``scan.unit`` or ``scan.misaligned``, each with
    ``file`` and, where it helps, ``line``, ``vertex``, ``expected`` and ``found``.
    """
    file, suffix = path.name, check_suffix(path, REGISTERED_FORMATS)
    content = read_content(path, MAX_REGISTERED_BYTES, "a registered scan")
    confidence = np.ones(vertex_count)
    if suffix == ".obj":
        vertices = read_obj(file, content)
    elif suffix == ".ply":
        vertices, confidence = _split(file, read_ply(file, content, CONFIDENCE))
    elif suffix == ".stl":
        vertices = read_stl(file, content, faces, vertex_count)
    else:
        vertices = read_glb(file, content)
    if len(vertices) != vertex_count:
        raise wrong_vertex_count(file, vertex_count, len(vertices))
    check_finite(file, vertices)
    check_scale(file, vertices)
    check_vertex_order(file, vertices, faces)
    if neutral is not None:
        check_alignment(file, vertices, neutral)
    return RegisteredScan(vertices, confidence)


def _split(file: str, columns: Floats) -> tuple[Floats, Floats]:
    """Return the vertices (n, 3) and the confidence (n,), which must lie in [0, 1]."""
    if columns.shape[1] == 3:
        return columns, np.ones(len(columns))
    vertices, confidence = columns[:, :3], columns[:, 3]
    wrong = ~((confidence >= 0) & (confidence <= 1))
    if wrong.any():
        vertex = int(np.argmax(wrong))
        raise InputError(
            "scan.confidence",
            f"{file}: vertex {vertex} has confidence {confidence[vertex]}, not within 0 and 1",
            file=file,
            vertex=vertex,
            found=str(confidence[vertex]),
        )
    return vertices, confidence
