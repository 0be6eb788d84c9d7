"""Reading a raw scan: any mesh or point cloud, faithfully, in any of five formats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.scans.content import read_content
from solver.scans.faults import check_suffix
from solver.scans.glb import MM_PER_METRE
from solver.scans.mesh import Mesh
from solver.scans.raw_glb import read_raw_glb
from solver.scans.raw_obj import read_raw_obj
from solver.scans.raw_ply import read_raw_ply
from solver.scans.raw_stl import read_raw_stl
from solver.scans.sniff import sniff
from solver.scans.xyz import read_xyz
from solver.surface import Floats, Ints

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
