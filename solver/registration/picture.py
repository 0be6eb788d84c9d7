"""``distance.png``: the raw scan, the registered face and the distance between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.drawing.head import Head
from solver.drawing.page import HEADER, Page
from solver.drawing.raster import Camera
from solver.drawing.render import Body, Lit, render
from solver.registration.register import Registration
from solver.registration.scan_surface import ScanSurface
from solver.registration.topology import Topology
from solver.surface import Floats, Ints, Surface

CELL = (500, 440)
TITLE = 34
VIEWS = np.radians([0.0, 50.0, -50.0])
GREY = (0.42, 0.42, 0.43)
DOT_MM = 1.2


def distance_picture(registered: Registration, topology: Topology, path: Path) -> None:
    """Draw scan, registration and distance side by side, from the front and both sides."""
    scan, skin, trust = registered.start.scan, registered.skin, registered.trust
    head = Head(topology.template.skin)
    lit = head.lit(skin.vertices)
    raw = _scan_body(scan, registered.motion(scan.vertices))
    columns = {
        "raw scan": raw,
        "registered": head.body(lit),
        "distance": head.heat_map(lit, trust.distance_mm),
    }
    page = Page(len(columns) * CELL[0], HEADER + TITLE + len(VIEWS) * CELL[1] + 72)
    seen = topology.face[trust.covered[topology.face]]
    distance = trust.distance_mm[seen]
    page.heading(
        "Registration",
        f"mean {distance.mean():.2f} mm    95 % below {np.percentile(distance, 95):.2f} mm    "
        f"{len(seen) / len(topology.face):.0%} of the face in the scan (grey: not in it)",
    )
    for column, (title, body) in enumerate(columns.items()):
        for row, yaw in enumerate(VIEWS):
            image = render([body], _camera(skin.vertices[topology.face], yaw), *CELL)
            page.panel((column * CELL[0], HEADER + TITLE + row * CELL[1]), image)
        page.text((column * CELL[0] + CELL[0] // 2, HEADER), title, 20, anchor="ma")
    page.scale((2 * CELL[0] + 50, HEADER + TITLE + len(VIEWS) * CELL[1] + 16), CELL[0] - 150)
    page.save(path)


def _camera(face: Floats, yaw: float) -> Camera:
    low, high = face.min(axis=0), face.max(axis=0)
    centre = (low + high) / 2
    centre[2] = low[2]
    return Camera(centre, span=1.4 * float(high[1] - low[1]), yaw=yaw)


def _scan_body(scan: ScanSurface, vertices: Floats) -> Body:
    surface = Surface(vertices, scan.faces)
    if not len(scan.faces):
        surface = _dots(vertices)
    return Body(Lit(surface), np.broadcast_to(GREY, surface.vertices.shape))


def _dots(points: Floats) -> Surface:
    """Return a small triangle at every point, facing forward."""
    angles = np.radians([90.0, 210.0, 330.0])
    corner = DOT_MM * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    faces: Ints = np.arange(3 * len(points)).reshape(-1, 3)
    return Surface((points[:, None] + corner).reshape(-1, 3), faces)
