"""Which skin a scanner can see: not the linings of mouth, nose and lids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.template import Template
from solver.drawing.raster import Camera, look

PIXELS = 640
YAWS = np.radians([0, 30, 60, 90, 130, 180, 230, 270, 300, 330])
PITCHES = np.radians([-35, 0, 35])


def outer_skin(template: Template) -> NDArray[np.bool_]:
    """Return which skin vertices (n,) of the template's flesh are seen from outside."""
    skin = template.skin
    centre = (skin.vertices.min(axis=0) + skin.vertices.max(axis=0)) / 2
    span = 1.2 * float(np.ptp(skin.vertices, axis=0).max())
    seen = np.zeros(len(skin.faces), dtype=bool)
    for yaw in YAWS:
        for pitch in PITCHES:
            triangle = look(Camera(centre, span, yaw, pitch), skin, PIXELS, PIXELS).triangle
            seen[np.unique(triangle[triangle >= 0])] = True
    flesh = np.zeros(len(skin.faces), dtype=bool)
    flesh[template.flesh_faces] = True
    outer = np.zeros(len(skin.vertices), dtype=bool)
    outer[skin.faces[seen & flesh]] = True
    return outer
