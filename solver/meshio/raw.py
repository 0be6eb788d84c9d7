"""Raw scans: any mesh or point cloud, read faithfully in any of five formats, and mended."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.meshio.glb import MM_PER_METRE, read_glb
from solver.meshio.mesh import Mesh, alike, check_suffix, read_content, too_large_error, weld
from solver.meshio.obj import read_obj
from solver.meshio.ply import read_ply
from solver.meshio.soup import FACET, HEADER_BYTES, read_stl, read_xyz
from solver.surface import Floats, Ints, area_normals, edge_keys

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
    """A scan as its file holds it: unit, axes and faults are the file's."""

    file: str  # its name, for messages
    vertices: Floats  # (n, 3) in the file's unit; not-a-number and duplicate vertices are kept
    faces: Ints  # (f, 3) triangles; (0, 3) for a point cloud
    normals: Floats | None  # (n, 3) as stored; None where the file has none
    colours: Floats | None  # (n, 3) in [0, 1]; None where the file has none
    mm_per_unit: float | None  # that the format declares (glTF: 1000), None where it does not
    format: str  # of the content, a key of READERS
    suffix_format: str  # that the suffix says
    empty_groups: tuple[str, ...] = ()  # names of groups, objects or parts without a face

    def part(self, kept: Ints, faces: Ints) -> RawScan:
        """Return the vertices ``kept``, with ``faces`` of their new numbers."""
        normals, colours = (
            None if values is None else values[kept] for values in (self.normals, self.colours)
        )
        vertices = self.vertices[kept]
        return replace(self, vertices=vertices, faces=faces, normals=normals, colours=colours)


def read_raw(path: Path) -> RawScan:
    """Read a raw scan: OBJ, PLY, STL, GLB or a point cloud as text.

    The content decides what it is read as: a wrong suffix shows in ``suffix_format``. Raises
    :class:`InputError`: ``scan.format`` (unknown suffix or an unsupported form of a format),
    ``scan.wrong_extension`` (no scan at all), ``scan.too_large``, ``scan.empty``,
    ``scan.unreadable`` or ``scan.truncated``, each with ``file`` and, where it helps, ``line``.
    """
    file = path.name
    suffix = check_suffix(path, FORMATS)
    content = read_content(path, MAX_BYTES, "a raw scan")
    format_ = sniff(file, content, FORMATS[suffix])
    mesh = READERS[format_](file, content)
    if len(mesh.vertices) > MAX_VERTICES:
        raise too_large_error(file, "vertices", len(mesh.vertices), "a raw scan", MAX_VERTICES)
    unit = MM_PER_METRE if format_ == "glb" else None
    surface = mesh.vertices, mesh.faces.astype(np.int64, copy=False), mesh.normals, mesh.colours
    return RawScan(file, *surface, unit, format_, FORMATS[suffix], mesh.empty_groups)


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
# No blank can be taken in two ways, so that a long run of them is passed once.
STL_TEXT = re.compile(rb"\s*solid\b(?:.*\s|.*\n\s*)(?:facet|endsolid)\b")
POINT_LINE = re.compile(rb"^[ \t]*[-+\d.][-+\d.eE]*([ \t,;]+[-+\w.]+){2,}[ \t\r]*$", re.MULTILINE)


def sniff(file: str, content: bytes, suffix_format: str) -> str:
    """Return the format that ``content`` holds; in doubt the one its suffix says.

    Raises :class:`InputError` (``scan.wrong_extension``) if it is known to be no scan at all.
    """
    head = content[:HEAD_BYTES]
    found = next((what for magic, what in OTHERS.items() if head.startswith(magic)), None)
    if found is not None:
        message = f"{file} is {found}, not a scan in {suffix_format.upper()} format"
        about = {"file": file, "expected": suffix_format, "found": found}
        raise InputError("scan.wrong_extension", message, **about)
    if re.match(rb"ply\r?\n", head):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if b"\0" in head:
        facets = int.from_bytes(content[80:84], "little")
        is_stl = len(content) == HEADER_BYTES + facets * FACET.itemsize
        return "stl" if is_stl else suffix_format
    if STL_TEXT.match(head):
        return "stl"
    if OBJ_LINE.search(head):
        return "obj"
    return "xyz" if POINT_LINE.search(head) else suffix_format


# Mending what has one remedy, and counting it.

# A triangle is flat if twice its area is less than this share of its longest edge squared.
FLAT = 1e-7
# A coordinate beyond this counts as infinite: distances from it cannot be measured.
ENDLESS = 1e100
# Of stored normals, the share that has to have a length for them to count.
MOST_KNOWN = 0.5
# Fewer vertices in the place of another are separate parts that touch, and stay.
WELDED_SHARE = 0.02


@dataclass(frozen=True)
class Mending:
    """Counts of each fault of a raw scan."""

    not_finite: int = 0  # vertices
    first_not_finite: int = -1  # the first of these vertices, -1 for none
    duplicate: int = 0  # vertices in the place of another
    flat: int = 0  # triangles without area
    repeated: int = 0  # triangles with the same corners as another
    unused: int = 0  # vertices in no triangle
    non_manifold: int = 0  # edges of three triangles or more
    flipped: int = 0  # triangles wound against the most of their piece


def mend(scan: RawScan) -> tuple[RawScan, Mending]:
    """Return the scan without the faults that have one remedy, and how many there were.

    Vertices that are not finite go, with their triangles; many vertices in the place of others
    become one with them; flat and repeated triangles go; the triangles of each piece are wound
    alike, as most of them were; vertices that no triangle uses go. The unit and axes stay.
    """
    finite = np.asarray((np.abs(scan.vertices) < ENDLESS).all(axis=1))
    lost = np.flatnonzero(~finite)
    numbers = np.flatnonzero(finite)
    first, place = weld(scan.vertices[finite])
    duplicate = len(numbers) - len(first)
    if duplicate <= WELDED_SHARE * len(numbers):
        first = place = np.arange(len(numbers), dtype=np.int64)
    new_number = np.full(len(finite), -1)
    new_number[numbers] = place
    faces: Ints = new_number[scan.faces[finite[scan.faces].all(axis=1)]]
    kept = numbers[first]
    counts = Mending(len(lost), int(lost[0]) if len(lost) else -1, duplicate)
    if len(scan.faces):
        flat = _is_flat(scan.vertices[kept], faces)
        faces = faces[~flat]
        single, _ = alike(np.sort(faces, axis=1).astype(np.uint64))
        repeated = len(faces) - len(single)
        faces = faces[single]
        against = _run_against(faces)
        faces[against] = faces[against][:, ::-1]
        used = np.zeros(len(kept), bool)
        used[faces] = True
        _, triangles_of_edge = np.unique(edge_keys(faces, directed=False), return_counts=True)
        counts = replace(
            counts,
            flat=int(flat.sum()),
            repeated=repeated,
            unused=int((~used).sum()),
            non_manifold=int((triangles_of_edge > 2).sum()),
            flipped=int(against.sum()),
        )
        kept = kept[used]
        faces = (np.cumsum(used) - 1)[faces]
    mended = scan.part(kept, faces)
    if mended.normals is not None and not _are_known(mended.normals):
        mended = replace(mended, normals=None)
    return mended, counts


def _are_known(normals: Floats) -> bool:
    """Return whether most of stored normals (n, 3) are directions: some programs write zeros."""
    lengths = np.linalg.norm(np.nan_to_num(normals), axis=1)
    return float(np.mean(lengths > 0.0)) > MOST_KNOWN if len(lengths) else False


def _is_flat(vertices: Floats, faces: Ints) -> NDArray[np.bool_]:
    double_area = np.linalg.norm(area_normals(vertices, faces), axis=1)
    sides = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
    return np.asarray(double_area <= FLAT * (sides**2).sum(axis=2).max(axis=1))


def _run_against(faces: Ints) -> NDArray[np.bool_]:
    """Return which triangles run against the most of their piece."""
    directed = edge_keys(faces, directed=True)
    if (np.diff(np.sort(directed)) > 0).all():  # neighbours run along their edge in opposite ways
        return np.zeros(len(faces), bool)
    wound, piece = igl.bfs_orient(faces)
    turned = (np.asarray(wound) != faces).any(axis=1)
    most = (np.bincount(piece, turned) > 0.5 * np.bincount(piece))[piece]
    return np.asarray(turned ^ most)
