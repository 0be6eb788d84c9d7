"""Reading a registered scan: a mesh with the template's vertices, in the template's order."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.scans.content import read_content
from solver.scans.faults import check_finite, check_suffix, wrong_vertex_count
from solver.scans.glb import read_glb
from solver.scans.obj import read_obj
from solver.scans.plausible import check_alignment, check_scale, check_vertex_order
from solver.scans.ply import read_ply
from solver.scans.registered import CONFIDENCE, RegisteredScan
from solver.scans.stl import read_stl
from solver.surface import Floats, Ints

FORMATS = (".obj", ".ply", ".stl", ".glb")
MAX_BYTES = 256 * 2**20


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
    file, suffix = path.name, check_suffix(path, FORMATS)
    content = read_content(path, MAX_BYTES, "a registered scan")
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
