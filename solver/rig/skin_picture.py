"""A picture of a template's skin: its regions in colours, its landmarks by number."""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np

from solver.anatomy.template import Template
from solver.drawing import colours
from solver.drawing.head import Head
from solver.drawing.page import HEADER, INK, MARGIN, Colour, Page, swatch_columns, swatch_height
from solver.drawing.raster import Camera
from solver.drawing.render import Body, render
from solver.normals import vertex_normals
from solver.surface import Floats, Surface

WIDTH, CELL_HEIGHT = 1800, 900
VIEWS = (("front", 0.0), ("left", np.radians(55.0)))
FACING = 0.15
"""Landmarks on skin that is turned further away (cosine) are not drawn."""
DOT = 3


def skin_picture(template: Template, path: Path) -> None:
    """Draw the skin from the front and the left, with a list of regions and landmarks."""
    palette = _palette(list(template.regions))
    legend = {**palette, **_numbered(template)}
    rows = -(-len(legend) // swatch_columns(WIDTH - 2 * MARGIN))
    page = Page(WIDTH, HEADER + CELL_HEIGHT + MARGIN + rows * swatch_height() + MARGIN)
    page.heading(
        f"Skin of template {template.name} {template.version}",
        f"{len(template.regions)} regions, {len(template.landmarks)} landmarks",
    )
    body = _body(template, palette)
    width = WIDTH // len(VIEWS)
    for column, (_, yaw) in enumerate(VIEWS):
        camera = _camera(template, yaw)
        corner = (column * width, HEADER)
        page.panel(corner, render([body], camera, width, CELL_HEIGHT))
        _mark(page, template, camera, corner, width)
    page.swatches((MARGIN, HEADER + CELL_HEIGHT + MARGIN), legend, WIDTH - 2 * MARGIN)
    page.save(path)


def _body(template: Template, palette: dict[str, Colour]) -> Body:
    head = Head(template.skin)
    lit = head.lit(template.skin.vertices)
    colour = head.body(lit).colour.copy()
    for name, vertices in template.regions.items():
        colour[vertices] = colours.linear(np.array(palette[name]))
    return Body(lit, colour, gloss=0.0)


def _mark(
    page: Page, template: Template, camera: Camera, corner: tuple[int, int], width: int
) -> None:
    """Put a dot and the number of each landmark that faces the camera."""
    if not template.landmarks:
        return
    vertices = np.array(list(template.landmarks.values()))
    points = template.skin.vertices[vertices]
    flesh = Surface(template.skin.vertices, template.skin.faces[template.flesh_faces])
    facing = vertex_normals(flesh)[vertices] @ camera.axes[2]
    for number, (x, y, _) in enumerate(camera.project(points, width, CELL_HEIGHT), start=1):
        if facing[number - 1] > FACING:
            place = (corner[0] + round(x), corner[1] + round(y))
            box = [place[0] - DOT, place[1] - DOT, place[0] + DOT, place[1] + DOT]
            page.draw.ellipse(box, fill=INK)
            page.text((place[0] + DOT + 2, place[1]), str(number), 13, anchor="lm")


def _numbered(template: Template) -> dict[str, Colour]:
    ink: Colour = (INK[0] / 255, INK[1] / 255, INK[2] / 255)
    return {f"{number}  {name}": ink for number, name in enumerate(template.landmarks, start=1)}


def _palette(names: list[str]) -> dict[str, Colour]:
    """Return pale sRGB colours, hues by the golden ratio."""
    return {
        name: colorsys.hls_to_rgb((0.04 + number * 0.381966) % 1.0, 0.72, 0.55)
        for number, name in enumerate(names)
    }


def _camera(template: Template, yaw: float) -> Camera:
    face: Floats = template.skin.vertices[template.face_vertices]
    low, high = face.min(axis=0), face.max(axis=0)
    return Camera((low + high) / 2, span=1.3 * float(high[1] - low[1]), yaw=yaw)
