"""``registration.json``: how well a scan was registered, and what that means, in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solver.drawing.head import DrawnHead
from solver.drawing.render import Camera, DrawnBody, Lit, render
from solver.drawing.sheet import HEADER, Sheet
from solver.errors import Finding, Severity
from solver.model import SizeFrom
from solver.registration.register import RegisteredFace, Trust
from solver.registration.scan_surface import ScanSurface
from solver.registration.topology import Topology
from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class ReportLimits:
    """Beyond these a registration has a finding."""

    mean_mm: float = 0.5  # distance to the scan
    p95_mm: float = 1.5  # distance of 95 %
    little_cover: float = 0.5  # share of the face, or of a region
    much_cover: float = 0.9  # share without a finding
    unusual_shape: float = 2.0  # times the expected length of the identity weights


REPORT_LIMITS = ReportLimits()


def report(registered: RegisteredFace, topology: Topology, size_from: SizeFrom) -> dict[str, Any]:
    """Return the figures and findings as plain JSON values; lengths in mm.

    Distances are from registered vertices to the scan's surface, over the covered outer face;
    ``coverage`` is the share of the outer face that the scan shows. An expression has its size from
    where its neutral has it, ``size_from``. ``motion`` takes a point p of
    the file to scale * rotation p + translation.
    """
    start = registered.start
    trust = registered.trust
    face = topology.face
    distance = trust.distance_mm[face[trust.covered[face]]]
    regions = _regions(trust, topology)
    motion = registered.motion
    return {
        "mean_mm": _round(distance.mean()),
        "p95_mm": _round(np.percentile(distance, 95)),
        "max_mm": _round(distance.max()),
        "coverage": _round(len(distance) / len(face)),
        "mean_confidence": _round(trust.confidence[face].mean()),
        "folded": len(registered.folded),
        "vertices": len(registered.skin.vertices),
        "scan_vertices": len(registered.scan.vertices),
        "regions": regions,
        **(start.size.figures | {"size_from": size_from}),
        "motion": {
            "scale": start.mm_per_unit * motion.scale,
            "rotation": np.round(motion.rotation, 9).tolist(),
            "rotation_degrees": _round(motion.degrees),
            "translation": np.round(motion.shift, 6).tolist(),
        },
        "shape_weights": np.round(registered.shape_weights, 4).tolist(),
        "findings": [
            finding.to_dict()
            for finding in (
                *registered.size_findings,
                *_findings(registered, topology, distance, regions),
            )
        ],
    }


def _findings(
    registered: RegisteredFace,
    topology: Topology,
    distance: Floats,
    regions: dict[str, dict[str, Any]],
) -> Iterator[Finding]:
    """Yield what an operator should know, given the face's ``distance`` where it is covered."""
    coverage = len(distance) / len(topology.face)
    if coverage < REPORT_LIMITS.much_cover:
        severity: Severity = "warning" if coverage < REPORT_LIMITS.little_cover else "info"
        message = (
            f"The scan shows {coverage:.0%} of the face; the rest is filled in smoothly and does "
            "not count in the fits."
        )
        advice = "Fill large holes by another take, if they lie where the face moves."
        yield Finding("registration.holes", severity, message, advice)
    mean = distance.mean()
    p95 = np.percentile(distance, 95)
    if mean > REPORT_LIMITS.mean_mm or p95 > REPORT_LIMITS.p95_mm:
        message = (
            f"The registered face lies {mean:.2f} mm off the scan on average, 95 % of it within "
            f"{p95:.2f} mm."
        )
        advice = "Look at distance.png: hair, a beard, glasses or spikes show in dark red."
        yield Finding("registration.far", "warning", message, advice)
    unseen = sorted(
        name for name in regions if regions[name]["coverage"] < REPORT_LIMITS.little_cover
    )
    if unseen:
        message = f"Mostly not in the scan: {', '.join(unseen).replace('_', ' ')}."
        advice = "Their shape is the likeliest one, not a measured one."
        yield Finding("registration.unseen_regions", "info", message, advice)
    shapes = topology.template.shapes
    weights = registered.shape_weights
    if shapes is not None and len(weights) == len(shapes.identity):
        length = float(np.linalg.norm(weights) / np.sqrt(max(len(weights), 1)))
        if length > REPORT_LIMITS.unusual_shape:
            message = "The face differs much from those the template knows."
            advice = "Check distance.png; give landmarks if eyes or mouth are in the wrong place."
            yield Finding("registration.unusual_shape", "info", message, advice)
    if registered.opened:
        both = len(registered.opened) == 2
        which = "both eyes" if both else f"the {next(iter(registered.opened))} eye"
        message = f"The lids of {which} are shut in the scan; the template's shape opens them."
        advice = "Nobody has measured them open: scan again with open eyes, if lids matter."
        yield Finding("registration.eyes_opened", "warning", message, advice)
    if len(registered.folded):
        message = f"{len(registered.folded)} triangles of the registered skin are turned over."
        advice = "Check distance.png where the skin is creased."
        yield Finding("registration.folded", "warning", message, advice)


def _regions(trust: Trust, topology: Topology) -> dict[str, dict[str, Any]]:
    figures = {}
    for name, vertices in topology.template.regions.items():
        outer = np.intersect1d(vertices, topology.face)
        if len(outer):
            seen = outer[trust.covered[outer]]
            figures[name] = {
                "coverage": _round(len(seen) / len(outer)),
                "mean_mm": _round(trust.distance_mm[seen].mean()) if len(seen) else None,
            }
    return figures


def _round(value: float | np.floating) -> float:
    return round(float(value), 4)


CELL = (500, 440)  # pixels of a view
TITLE = 34  # height of a column's title in pixels
VIEWS = np.radians([0.0, 50.0, -50.0])  # yaws
GREY = (0.42, 0.42, 0.43)  # of a raw scan
DOT_MM = 1.2  # radius of a point of a cloud


def distance_picture(registered: RegisteredFace, topology: Topology, path: Path) -> None:
    """Draw scan, registration and distance side by side, from the front and both sides."""
    scan = registered.scan
    skin = registered.skin
    trust = registered.trust
    head = DrawnHead(topology.template.skin)
    lit = head.lit(skin.vertices)
    raw = _scan_body(scan, registered.motion(scan.vertices))
    columns = {
        "raw scan": raw,
        "registered": head.body(lit),
        "distance": head.heat_map(lit, trust.distance_mm),
    }
    page = Sheet(len(columns) * CELL[0], HEADER + TITLE + len(VIEWS) * CELL[1] + 72)
    seen = topology.face[trust.covered[topology.face]]
    distance = trust.distance_mm[seen]
    page.heading(
        "Registration",
        f"mean {distance.mean():.2f} mm    95 % below {np.percentile(distance, 95):.2f} mm    "
        f"{len(seen) / len(topology.face):.0%} of the face in the scan (grey: not in it)",
    )
    for column, (title, body) in enumerate(columns.items()):
        cameras = [_camera(skin.vertices[topology.face], yaw) for yaw in VIEWS]
        images = [render([body], camera, *CELL) for camera in cameras]
        page.column((column * CELL[0], HEADER), title, images, 20, TITLE)
    page.scale((2 * CELL[0] + 50, HEADER + TITLE + len(VIEWS) * CELL[1] + 16), CELL[0] - 150)
    page.save(path)


def _camera(face: Floats, yaw: float) -> Camera:
    low = face.min(axis=0)
    high = face.max(axis=0)
    centre = (low + high) / 2
    centre[2] = low[2]
    return Camera(centre, span=1.4 * float(high[1] - low[1]), yaw=yaw)


def _scan_body(scan: ScanSurface, vertices: Floats) -> DrawnBody:
    surface = Surface(vertices, scan.faces) if len(scan.faces) else _dots(vertices)
    return DrawnBody(Lit(surface), np.broadcast_to(GREY, surface.vertices.shape))


def _dots(points: Floats) -> Surface:
    """Return a small triangle at every point, facing forward."""
    angles = np.radians([90.0, 210.0, 330.0])
    corner = DOT_MM * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    faces: Ints = np.arange(3 * len(points)).reshape(-1, 3)
    return Surface((points[:, None] + corner).reshape(-1, 3), faces)
