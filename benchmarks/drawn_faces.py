"""Faces as they are drawn for a detector: with brows and lips painted, without which it sees less.

Detectors know brows by their hair: on a bare face those of a raised brow hardly leave 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.drawing.head import COLOURS, DrawnHead
from solver.drawing.render import Camera, DrawnBody, Lit, Pixels, render
from solver.model import SubjectModel
from solver.photo.mesh_points import is_within
from solver.registration.detector import LIP_OUTLINE, DetectedFace, FaceDetector
from solver.surface import Floats, Surface

# landmarks along the upper edge of each brow from the nose on, and back along the lower one
BROWS = {
    "right": (*(107, 66, 105, 63, 70), *(46, 53, 52, 65, 55)),
    "left": (*(336, 296, 334, 293, 300), *(276, 283, 282, 295, 285)),
}


@dataclass(frozen=True)
class DrawnFaceOptions:
    """How faces are drawn."""

    pixels: int = 384  # a side
    span: float = 1.9  # of the picture, by the face's height
    brow: tuple[float, float, float] = (0.05, 0.03, 0.02)  # linear RGB
    finer: int = 1  # times that triangles of the skin are cut in four
    lip_depth_mm: float = 8.0  # further behind the corners of the mouth nothing is painted
    distance_mm: float = 600.0  # of the camera, a usual one for a face in a film


DRAWN = DrawnFaceOptions()


class DrawnFaces:
    """Draws skins of a person, whose template's ``points`` say where brows and lips are."""

    def __init__(
        self, model: SubjectModel, points: SkinPoints, options: DrawnFaceOptions = DRAWN
    ) -> None:
        self.options = options
        skin = model.skin
        self._head = DrawnHead(skin)
        neutral = skin.vertices
        fine, faces = igl.upsample(neutral, self._head.skin, options.finer)
        self._faces = faces.astype(np.int64)
        self._colour = np.tile(COLOURS["skin"], (len(fine), 1))
        lips = points.select([str(row) for row in LIP_OUTLINE if points.has(str(row))]).at(neutral)
        in_front = fine[:, 2] > lips[:, 2].min() - options.lip_depth_mm
        self._colour[in_front & is_within(fine[:, :2], lips[:, :2])] = COLOURS["lips"]
        for numbers in BROWS.values():
            names = [str(row) for row in numbers if points.has(str(row))]
            outline = points.select(names).at(neutral)
            self._colour[(fine[:, 2] > 0.0) & is_within(fine[:, :2], outline[:, :2])] = options.brow
        face = neutral[model.face]
        low, high = face.min(axis=0), face.max(axis=0)
        height = float(high[1] - low[1])
        self._camera = Camera(
            (low + high) / 2, span=options.span * height, distance=options.distance_mm
        )

    def picture(self, skin: Floats) -> Pixels:
        """Return a skin (v, 3) from the front, sRGB (h, w, 3) from 0 to 1."""
        size = self.options.pixels
        lit = self._head.lit(skin)
        inner = np.vstack([self._head.teeth, self._head.mouth, self._head.eyes])
        fine, _ = igl.upsample(skin, self._head.skin, self.options.finer)
        vertices = np.vstack([fine, lit.surface.vertices])
        faces = np.vstack([self._faces, inner + len(fine)])
        colour = np.vstack([self._colour, self._head.body(lit).colour])
        return render([DrawnBody(Lit(Surface(vertices, faces)), colour)], self._camera, size, size)

    def look(self, skin: Floats, detector: FaceDetector) -> DetectedFace | None:
        """Return the face that a detector sees in the picture of a skin (v, 3)."""
        found = detector.faces(self.picture(skin))
        return max(found, key=lambda face: face.eyes_px) if found else None
