"""Faces with brows and lips painted on: pictures that a detector, and a person, reads better.

Detectors know brows by their hair: on a bare face their weights of a raised brow hardly leave 0.
"""

from __future__ import annotations

from collections.abc import Sequence
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
class PaintOptions:
    """Colours and sizes of painted faces."""

    size: tuple[int, int] = (384, 384)  # of a picture, px
    span: float = 1.45  # of the picture, by the face's height
    brow: tuple[float, float, float] = (0.05, 0.03, 0.02)  # linear RGB
    finer: int = 1  # times that triangles of the skin are cut in four
    depth_mm: float = 8.0  # further behind the outline of a part nothing is painted
    distance_mm: float = 600.0  # of the camera, a usual one for a face in a film


PAINT = PaintOptions()


class PaintedFaces:
    """Draws skins of a person, whose template's ``points`` say where brows and lips are."""

    def __init__(
        self, model: SubjectModel, points: SkinPoints, options: PaintOptions = PAINT
    ) -> None:
        self.options = options
        skin = model.skin
        self._head = DrawnHead(skin)
        neutral = skin.vertices
        fine, faces = igl.upsample(neutral, self._head.skin, options.finer)
        self._faces = faces.astype(np.int64)
        self._colour = np.tile(COLOURS["skin"], (len(fine), 1))
        self._paint(fine, points, neutral, LIP_OUTLINE, COLOURS["lips"])
        for brow in BROWS.values():
            self._paint(fine, points, neutral, brow, options.brow)
        face = neutral[model.face]
        low = face.min(axis=0)
        high = face.max(axis=0)
        height = float(high[1] - low[1])
        self.camera = Camera(
            (low + high) / 2, span=options.span * height, distance=options.distance_mm
        )

    def _paint(
        self,
        fine: Floats,
        points: SkinPoints,
        neutral: Floats,
        numbers: Sequence[int],
        colour: tuple[float, ...],
    ) -> None:
        """Colour the vertices ``fine`` (n, 3) within an outline of landmarks, from the front."""
        names = [str(number) for number in numbers if points.has(str(number))]
        outline = points.select(names).at(neutral)
        in_front = fine[:, 2] > outline[:, 2].min() - self.options.depth_mm
        self._colour[in_front & is_within(fine[:, :2], outline[:, :2])] = colour

    def picture(self, skin: Floats) -> Pixels:
        """Return a skin (v, 3) from the front, sRGB (h, w, 3) from 0 to 1."""
        lit = self._head.lit(skin)
        inner = np.vstack([self._head.teeth, self._head.mouth, self._head.eyes])
        fine, _ = igl.upsample(skin, self._head.skin, self.options.finer)
        vertices = np.vstack([fine, lit.surface.vertices])
        faces = np.vstack([self._faces, inner + len(fine)])
        colour = np.vstack([self._colour, self._head.body(lit).colour])
        body = DrawnBody(Lit(Surface(vertices, faces)), colour)
        return render([body], self.camera, *self.options.size)

    def look(self, skin: Floats, detector: FaceDetector) -> DetectedFace | None:
        """Return the face that a detector sees in the picture of a skin (v, 3)."""
        found = detector.faces(self.picture(skin))
        return max(found, key=lambda face: face.eyes_px) if found else None
