"""Findings about what is in a scan and how it lies: a face at all, its unit, axes and winding."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from solver.scans.findings import Finding
from solver.scans.pose import CLOSE_MM, FacePoints
from solver.scans.raw import RawScan
from solver.scans.sample import Samples
from solver.scans.units import UNITS, Placement

MOST_INWARD, SOME_INWARD = 0.8, 0.1


def unit_findings(scan: RawScan, place: Placement, frame: Mapping[str, Any]) -> list[Finding]:
    """Return what the face's size says about the unit that was given, declared or assumed."""
    given = str(frame["unit"])
    expected = UNITS.get(given, scan.mm_per_unit or 1.0)
    figures = {"expected": expected, "found": place.mm_per_unit, "unit": place.unit}
    if place.mm_per_unit == expected:
        return []
    if place.unit is None and _is_slip(place.mm_per_unit / expected) is None:
        return [
            Finding(
                "scan.unit_unknown",
                "error",
                f"No unit makes the face in {scan.file} as large as a face.",
                figures,
            )
        ]
    ratio = expected / place.mm_per_unit
    size = f"{ratio:g} times too large" if ratio > 1 else f"{1 / ratio:g} times too small"
    source = (
        "as given" if given != "auto" else "as the format says" if scan.mm_per_unit else "in mm"
    )
    as_what = f"in {place.unit}" if place.unit else f"at {place.mm_per_unit:g} mm a unit"
    return [
        Finding(
            "scan.scale",
            "error" if given != "auto" else "warning",
            f"Read {source}, the face would be {size}; it fits {as_what}.",
            figures,
        )
    ]


def _is_slip(ratio: float) -> float | None:
    return next((slip for slip in (1e-3, 0.1, 10.0, 1e3) if np.isclose(ratio, slip)), None)


def axis_findings(place: Placement, frame: Mapping[str, Any]) -> list[Finding]:
    """Return how the scan is turned against y up and z forward."""
    figures = {"up": place.up, "forward": place.forward}
    upright = float(place.rotation[1] @ (0.0, 1.0, 0.0))
    if frame["up"] != "auto" or (place.up, place.forward) == ("y", "z"):
        return []
    if place.up.startswith("-") and place.up != "-x":
        message = f"The head stands upside down: {place.up} of the file points to its top."
        return [Finding("scan.upside_down", "warning", message, figures | {"upright": upright})]
    message = f"{place.up} of the file points to the top of the head, {place.forward} forward."
    return [Finding("scan.axes", "info", message, figures)]


def winding_findings(
    scan: RawScan, samples: Samples, face: FacePoints, place: Placement
) -> list[Finding]:
    """Return whether the triangles face inwards, which flipped normals and mirroring both do.

    Stored normals tell the two apart: mirroring turns them with the surface, but not the order of
    the triangles' corners.
    """
    if not samples.oriented:
        return []
    inward = _share_inward(samples, face, place)
    if inward < SOME_INWARD:
        return []
    figures = {"share": round(inward, 3)}
    if inward < MOST_INWARD:
        message = f"{inward:.0%} of the face's surface is inside out."
        return [Finding("scan.inverted_normals", "warning", message, figures)]
    stored = None
    if scan.normals is not None and len(scan.faces):
        stored = _share_inward(_stored(scan), face, place)
    inverted = Finding(
        "scan.inverted_normals", "warning", "The whole surface is inside out.", figures
    )
    if stored is not None and stored < 0.5:
        message = "The scan is mirrored: its triangles face inwards, its normals outwards."
        return [Finding("scan.mirrored", "error", message, figures)]
    if stored is not None or not len(scan.faces):
        return [inverted]
    message = (
        "The scan may be mirrored: its triangles face inwards, as mirroring makes them. "
        "Compare a mole or the parting with the person."
    )
    return [inverted, Finding("scan.mirrored", "warning", message, figures)]


def _stored(scan: RawScan) -> Samples:
    assert scan.normals is not None
    chosen = np.random.default_rng(0).permutation(len(scan.vertices))[:20000]
    return Samples(scan.vertices[chosen], np.nan_to_num(scan.normals[chosen]), True)


def _share_inward(samples: Samples, face: FacePoints, place: Placement) -> float:
    """Return the share of the face's points whose closest sample faces the other way."""
    there = samples.moved(place.pose.scale, place.pose.rotation, place.pose.translation)
    gap, near = KDTree(there.points).query(face.points)
    facing = (there.normals[near] * face.normals).sum(axis=1)[gap < CLOSE_MM]
    clear = facing[np.abs(facing) > 0.5]
    return float((clear < 0).mean()) if len(clear) else 0.0
