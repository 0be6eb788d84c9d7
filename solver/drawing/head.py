"""A scan topology ready to be drawn: coloured parts, and eyes with an iris."""

from __future__ import annotations

import igl
import numpy as np

from solver.drawing import colours
from solver.drawing.parts import skin_parts
from solver.drawing.render import Body, Lit
from solver.surface import Floats, Ints, Surface

EYE_SUBDIVISIONS = 2
NONE = np.zeros((0, 3), np.int64)


class Head:
    """The parts of ``neutral`` that are drawn: lashes are left out, eyeballs made finer.

    ``skin``, ``teeth``, ``mouth`` (gums and tongue) and ``eyes`` (the finer ones) are faces (f, 3).
    """

    def __init__(self, neutral: Surface) -> None:
        parts = {name: neutral.faces[faces] for name, faces in skin_parts(neutral).items()}
        self._colour = np.tile(colours.SKIN, (len(neutral.vertices), 1))
        for name, faces in parts.items():
            self._colour[faces] = colours.PARTS.get(name, colours.SKIN)
        self.skin = parts["skin"]
        self.teeth = parts.get("teeth", NONE)
        self.mouth = parts.get("mouth", NONE)
        self._eye_vertices, numbers = np.unique(parts.get("eyes", NONE), return_inverse=True)
        self._eye_faces: Ints = numbers.reshape(-1, 3).astype(np.int64)
        self.eyes = NONE
        if len(self._eye_vertices):
            fine, faces = igl.upsample(
                neutral.vertices[self._eye_vertices], self._eye_faces, EYE_SUBDIVISIONS
            )
            self.eyes = faces.astype(np.int64) + len(neutral.vertices)
            self._colour = np.vstack([self._colour, _eye_colour(fine)])

    def lit(self, vertices: Floats, light: Floats | None = None) -> Lit:
        """Return the whole head with its topology at ``vertices`` (v, 3), for the bodies below.

        ``light`` is that of the head in another pose, if it is to be had.
        """
        if len(self.eyes):
            eyes = vertices[self._eye_vertices]
            fine, _ = igl.upsample(eyes, self._eye_faces, EYE_SUBDIVISIONS)
            vertices = np.vstack([vertices, fine])
        surface = Surface(vertices, np.vstack([self.skin, self.teeth, self.mouth, self.eyes]))
        return Lit(surface, light)

    def body(self, lit: Lit, faces: Ints | None = None, *, opacity: float = 1.0) -> Body:
        """Return the head, or some of its faces, in natural colours."""
        return Body(lit, self._colour, faces=faces, opacity=opacity)

    def heat_map(self, lit: Lit, error_mm: Floats, most_mm: float = colours.HEAT_MAX_MM) -> Body:
        """Return the head in the colours of a distance (v,) in mm, grey where it is NaN."""
        colour = np.tile(colours.UNMEASURED, (len(self._colour), 1))
        measured = np.flatnonzero(np.isfinite(error_mm))
        colour[measured] = colours.linear(colours.heat(error_mm[measured], most_mm))
        return Body(lit, colour, gloss=0.04)


def _eye_colour(points: Floats) -> Floats:
    """Return the colours (n, 3) of two eyeballs that look forward."""
    colour = np.tile(colours.SCLERA, (len(points), 1))
    is_left = points[:, 0] > points[:, 0].mean()
    for eye in (np.flatnonzero(is_left), np.flatnonzero(~is_left)):
        offset = points[eye] - (points[eye].min(axis=0) + points[eye].max(axis=0)) / 2
        radius = np.hypot(offset[:, 0], offset[:, 1])
        front = offset[:, 2] > 0
        colour[eye[front & (radius < colours.IRIS_MM)]] = colours.IRIS
        colour[eye[front & (radius < colours.PUPIL_MM)]] = colours.PUPIL
    return colour
