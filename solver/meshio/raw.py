"""Raw scans: any mesh or point cloud, faithfully, in any of five formats."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.meshio.faults import check_suffix, read_content
from solver.meshio.glb import MM_PER_METRE, read_glb
from solver.meshio.mesh import Mesh
from solver.meshio.obj import read_obj
from solver.meshio.ply import read_ply
from solver.meshio.stl import FACET, HEADER_BYTES, read_stl
from solver.meshio.xyz import read_xyz
from solver.surface import Floats, Ints

READERS: dict[str, Callable[[str, bytes], Mesh]] = {
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
    "glb": read_glb,
    "xyz": read_xyz,
}
POINT_SUFFIXES = ("xyz", "pts", "asc", "csv", "txt", "xyzn", "xyzrgb")
FORMATS = {  # suffix -> format
    **{f".{name}": name for name in READERS},
    **{f".{suffix}": "xyz" for suffix in POINT_SUFFIXES},
}
MAX_BYTES = 512 * 2**20  # promised in docs/guide/scans.md
MAX_VERTICES = 8_000_000  # likewise


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
    format_ = sniff(file, content, FORMATS[suffix])
    mesh = READERS[format_](file, content)
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
        mm_per_unit=MM_PER_METRE if format_ == "glb" else None,
        format=format_,
        suffix_format=FORMATS[suffix],
        empty_groups=mesh.empty_groups,
    )


# The format by what a file holds, whatever its suffix says.

OTHERS = {  # how files begin that are no scan
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
HEAD_BYTES = 65536  # of a file that are looked at
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
