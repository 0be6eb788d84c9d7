"""Findings about the file and its mesh, before anything is known of a face."""

from __future__ import annotations

from solver.scans.findings import Finding, Severity
from solver.scans.mend import WELDED_SHARE, Mending
from solver.scans.raw import RawScan

MANY_NOT_FINITE = 0.2
FEW_FLAT = 0.0005
FEW_FLIPPED = 0.005
MANY_UNUSED = 0.2
TOUCHING_EDGES = 0.005
"""Where corners are joined by place, parts that touch give so many edges of three triangles."""
DENSE = 400_000


def file_findings(raw: RawScan, mending: Mending) -> list[Finding]:
    """Return what is wrong with a scan as it was stored, given what was mended in it."""
    vertices, triangles = len(raw.vertices), max(len(raw.faces), 1)
    found: list[Finding] = []

    def add(code: str, severity: Severity, message: str, **figures: object) -> None:
        found.append(Finding(code, severity, message, figures))

    if raw.format != raw.suffix_format:
        add(
            "scan.wrong_extension",
            "warning",
            f"{raw.file} holds {raw.format.upper()}, not {raw.suffix_format.upper()} as its "
            "suffix says; it was read as what it holds.",
            expected=raw.suffix_format,
            found=raw.format,
        )
    if mending.not_finite:
        share = mending.not_finite / vertices
        add(
            "scan.nan",
            "error" if share > MANY_NOT_FINITE else "warning",
            f"{_count(mending.not_finite, 'vertex', 'vertices')} of {vertices} "
            f"{'is' if mending.not_finite == 1 else 'are'} not a number; the first is vertex "
            f"{mending.first_not_finite} (counted from 0).",
            vertex=mending.first_not_finite,
            found=mending.not_finite,
        )
    if mending.duplicate:
        welded = mending.duplicate > WELDED_SHARE * vertices
        usual = raw.format in ("glb", "stl")  # which can not share vertices across a seam
        add(
            "scan.duplicate_vertices",
            "warning" if welded and not usual else "info",
            f"{_count(mending.duplicate, 'vertex lies', 'vertices lie')} exactly in the place of "
            "another.",
            found=mending.duplicate,
        )
    if mending.flat:
        add(
            "scan.zero_area_faces",
            "warning" if mending.flat > FEW_FLAT * triangles else "info",
            f"{_count(mending.flat, 'triangle has', 'triangles have')} no area.",
            found=mending.flat,
        )
    if mending.repeated:
        add(
            "scan.repeated_faces",
            "warning" if mending.repeated > FEW_FLAT * triangles else "info",
            f"{_count(mending.repeated, 'triangle is', 'triangles are')} there twice.",
            found=mending.repeated,
        )
    if mending.unused:
        add(
            "scan.unused_vertices",
            "warning" if mending.unused > MANY_UNUSED * vertices else "info",
            f"{_count(mending.unused, 'vertex is', 'vertices are')} in no triangle.",
            found=mending.unused,
        )
    if mending.non_manifold:
        usual = raw.format == "stl" or mending.duplicate > WELDED_SHARE * vertices
        few = usual and mending.non_manifold < TOUCHING_EDGES * 1.5 * triangles
        add(
            "scan.non_manifold",
            "info" if few else "warning",
            f"At {_count(mending.non_manifold, 'edge', 'edges')} three or more triangles meet.",
            found=mending.non_manifold,
        )
    if mending.flipped:
        add(
            "scan.inconsistent_normals",
            "warning" if mending.flipped > FEW_FLIPPED * triangles else "info",
            f"{_count(mending.flipped, 'triangle faces', 'triangles face')} the other way than "
            "the surface around.",
            found=mending.flipped,
        )
    if raw.empty_groups:
        names = ", ".join(raw.empty_groups[:5])
        add(
            "scan.empty_groups",
            "warning",
            f"{_count(len(raw.empty_groups), 'group holds', 'groups hold')} no triangle: {names}.",
            groups=list(raw.empty_groups[:20]),
        )
    if len(raw.faces) == 0 and raw.normals is None:
        add(
            "scan.no_normals",
            "warning",
            f"{raw.file} is a point cloud without normals; they are found from neighbours.",
        )
    if vertices > DENSE:
        add(
            "scan.dense",
            "warning",
            f"{vertices:,} vertices are more than a registration can use.",
            found=vertices,
            expected=DENSE,
        )
    return found


def _count(number: int, one: str, many: str) -> str:
    return f"{number:,} {one if number == 1 else many}"
