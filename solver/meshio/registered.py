"""Registered scans: meshes with the template's vertices, in the template's order.

A registered scan is read exactly, and checked: whether it can be this person's head in size, in the
order of its vertices and in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError
from solver.meshio.glb import MM_PER_METRE, read_glb
from solver.meshio.mesh import Mesh, check_finite, check_suffix, read_content, unsupported_error
from solver.meshio.obj import read_obj
from solver.meshio.ply import read_ply, write_ply
from solver.meshio.soup import read_stl
from solver.model import SIZE_WORDS, SizeFrom
from solver.similarity import weighted_motion
from solver.surface import Floats, Ints, Surface

READERS: dict[str, Callable[..., Mesh]] = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": read_stl,
    ".glb": read_glb,
}
REGISTERED_FORMATS = tuple(READERS)
MAX_BYTES = 256 * 2**20  # a head of a million vertices as text takes less
SIZE_COMMENT = "myoface size from"  # in a PLY, where the size is not the scan's own
UNITS = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4}  # name -> mm


@dataclass(frozen=True)
class PlausibleScan:
    """Bounds that a registered scan of any head keeps to."""

    # Largest extent: from a bare face to a head with neck and shoulders.
    head_mm: tuple[float, float] = (100.0, 700.0)
    # Most of the median edge by the largest extent; shuffled vertices give about 0.4.
    edge_ratio: float = 0.2
    # Off the neutral: a wide open jaw moves half of a bare face by about 10 mm.
    median_motion_mm: float = 25.0
    # Part of a rotation's squared distances that a mirror image leaves if it is the better one.
    mirrored: float = 0.25
    # Corners of an STL that are one vertex of the template lie no further apart.
    same_place_mm: float = 0.01


PLAUSIBLE = PlausibleScan()


@dataclass(frozen=True)
class RegisteredScan:
    """A registered scan; a file that says nothing about confidence is trusted everywhere."""

    vertices: Floats  # (n, 3) in mm
    confidence: Floats  # (n,) in [0, 1], 0 where nothing was seen
    size_from: SizeFrom = "scan"


def write_registered(
    path: Path, surface: Surface, confidence: Floats, size_from: SizeFrom = "scan"
) -> None:
    """Write a registered scan as PLY."""
    comment = "" if size_from == "scan" else f"{SIZE_COMMENT} {size_from}"
    write_ply(path, surface, {"confidence": confidence}, comment=comment)


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
    ``scan.vertex_order``, ``scan.confidence``, ``scan.unit``, ``scan.misaligned`` or
    ``scan.mirrored``, each with ``file`` and, where it helps, ``line``, ``vertex``, ``expected``
    and ``found``.
    """
    file = path.name
    suffix = check_suffix(path, REGISTERED_FORMATS)
    content = read_content(path, MAX_BYTES, "a registered scan")
    mesh = READERS[suffix](file, content, strict=True)
    vertices = mesh.vertices
    if suffix == ".stl":
        vertices = _number_facets(file, vertices, faces, vertex_count, PLAUSIBLE.same_place_mm)
    elif suffix == ".glb":
        with np.errstate(over="ignore"):
            vertices = vertices * MM_PER_METRE
    confidence = np.ones(len(vertices)) if mesh.confidence is None else mesh.confidence
    _check_confidence(file, confidence)
    if len(vertices) != vertex_count:
        message = (
            f"{file} has {len(vertices)} vertices; the template's topology has {vertex_count}; a "
            "raw scan is sent as raw and registered first"
        )
        about = {"file": file, "expected": vertex_count, "found": len(vertices)}
        raise InputError("scan.vertex_count", message, **about)
    check_finite(file, vertices)
    _check_scale(file, vertices)
    _check_vertex_order(file, vertices, faces)
    if neutral is not None:
        _check_alignment(file, vertices, neutral)
    return RegisteredScan(vertices, confidence, _size_from(content))


def _size_from(content: bytes) -> SizeFrom:
    """Return where a PLY says that its size comes from, in the first lines; else from the scan."""
    told = f"\ncomment {SIZE_COMMENT} "
    head = content[:1000].decode("ascii", "replace")
    return next((each for each in SIZE_WORDS if f"{told}{each}\n" in head), "scan")


def _check_confidence(file: str, confidence: Floats) -> None:
    """Raise ``scan.confidence`` unless all of the confidence (n,) lies in [0, 1]."""
    wrong = ~((confidence >= 0) & (confidence <= 1))
    if wrong.any():
        vertex = int(np.argmax(wrong))
        found = confidence[vertex]
        message = f"{file}: vertex {vertex} has confidence {found}, not within 0 and 1"
        raise InputError("scan.confidence", message, file=file, vertex=vertex, found=str(found))


def _number_facets(
    file: str, corners: Floats, faces: Ints, vertex_count: int, same_place_mm: float
) -> Floats:
    """Return vertices (vertex_count, 3) of an STL's ``corners`` (3 f, 3) by the template's faces.

    STL shares no vertices, so its facets must be the template's ``faces`` (f, 3) in the same order;
    corners that are one vertex in the template must lie in one place.
    """
    if len(corners) != faces.size:
        found = len(corners) // 3
        expected = len(faces)
        message = f"{file} has {found} triangles; the template has {expected}"
        raise InputError("scan.vertex_count", message, file=file, expected=expected, found=found)
    check_finite(file, corners)
    vertices = np.full((vertex_count, 3), np.nan)
    vertices[faces.ravel()] = corners
    loose = np.flatnonzero(np.isnan(vertices[:, 0]))
    if len(loose):
        vertex = int(loose[0])
        reason = f"STL cannot carry vertex {vertex}, which is in no triangle: use OBJ, PLY or GLB"
        raise unsupported_error(file, reason, vertex=vertex)
    apart = np.abs(vertices[faces] - corners.reshape(-1, 3, 3)).max(axis=(1, 2))
    if apart.max() > same_place_mm:
        triangle = int(np.argmax(apart > same_place_mm))
        message = (
            f"{file}: triangle {triangle} does not meet its neighbours as in the template; "
            "the triangles must be the template's, in the same order"
        )
        raise InputError("scan.vertex_order", message, file=file, triangle=triangle)
    return vertices


def _check_scale(file: str, vertices: Floats) -> None:
    """Raise ``scan.unit`` unless the vertices (n, 3) are as large as a head in mm."""
    with np.errstate(over="ignore"):
        extent = float(np.nan_to_num(np.ptp(vertices, axis=0).max()))
    low, high = PLAUSIBLE.head_mm
    if low <= extent <= high:
        return
    guess = next((unit for unit, factor in UNITS.items() if low <= extent * factor <= high), None)
    if low <= extent / 1000 <= high:
        hint = "it seems to hold millimetres where the format's unit is the metre"
    elif guess is not None:
        hint = f"it seems to be in {guess}: scale it by {UNITS[guess]:g}"
    else:
        hint = "it cannot be a head in mm"
    message = f"{file} is {extent:.4g} mm across, a head is {low:g} to {high:g} mm; {hint}"
    raise InputError("scan.unit", message, file=file, expected=[low, high], found=extent)


def _check_vertex_order(file: str, vertices: Floats, faces: Ints) -> None:
    """Raise ``scan.vertex_order`` if the template's faces (f, 3) join vertices far apart."""
    edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
    median = float(np.median(edges))
    extent = float(np.ptp(vertices, axis=0).max())
    if median > PLAUSIBLE.edge_ratio * extent:
        message = (
            f"{file}: neighbours in the template lie {median:.3g} mm apart; "
            "the vertices are not in the template's order"
        )
        raise InputError("scan.vertex_order", message, file=file, found=median)


def _check_alignment(file: str, vertices: Floats, neutral: Floats) -> None:
    """Raise ``scan.misaligned`` if the expression (n, 3) is far off the neutral (n, 3).

    Scans of one session share the skull's place; the message says by how much this one is moved.
    One that is the neutral's mirror image rather than moved is ``scan.mirrored``.
    """
    even = np.ones(len(vertices))
    mirrored = neutral * [-1.0, 1.0, 1.0]
    moved, flipped = (weighted_motion(start, vertices, even) for start in (neutral, mirrored))
    left = np.sum((moved(neutral) - vertices) ** 2)
    left_mirrored = np.sum((flipped(mirrored) - vertices) ** 2)
    # distances too small tell nothing: a flat surface is its own mirror image
    size = len(vertices) * float(np.var(neutral, axis=0).sum() + np.var(vertices, axis=0).sum())
    if left > 1e-3 * size and left_mirrored < PLAUSIBLE.mirrored * left:
        message = (
            f"{file} is mirrored against the neutral (left and right exchanged, or inside out): "
            "switch off mirroring in the export"
        )
        raise InputError("scan.mirrored", message, file=file)
    median = float(np.median(np.linalg.norm(vertices - neutral, axis=1)))
    if median <= PLAUSIBLE.median_motion_mm:
        return
    shift = float(np.linalg.norm(vertices.mean(axis=0) - neutral.mean(axis=0)))
    message = (
        f"{file} lies {median:.0f} mm off the neutral (median over all vertices): it is turned by "
        f"{moved.degrees:.0f} degrees and moved by {shift:.0f} mm; align its skull with the "
        "neutral's"
    )
    expected = PLAUSIBLE.median_motion_mm
    raise InputError("scan.misaligned", message, file=file, expected=expected, found=median)
