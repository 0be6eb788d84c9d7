"""An animation's frames as pictures, with what the face meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.drawing.head import Head
from solver.drawing.page import HEADER, MARGIN, Page
from solver.drawing.raster import Pixels
from solver.drawing.render import Body, Lit, faded, render
from solver.model import SubjectModel
from solver.rig.pictures import THREE_QUARTER, face_camera
from solver.surface import Floats, Surface

CELL = (300, 360)
COLUMNS = 4
OBJECT, OBJECT_OPACITY = (0.35, 0.45, 0.52), 0.3
"""Linear colour and opacity of what the face meets."""


class Filming:
    """Draws a subject's skins, one like the other: all from where the neutral is seen."""

    def __init__(self, model: SubjectModel) -> None:
        self._head = Head(model.skin)
        self._cameras = {
            yaw: face_camera(model.skin.vertices, model.face, yaw) for yaw in (0.0, THREE_QUARTER)
        }

    def light(self, skin: Floats) -> Floats:
        """Return the light on a skin (v, 3), for pictures of it and of skins that are alike."""
        return self._head.lit(skin).light

    def picture(
        self,
        skin: Floats,
        light: Floats,
        size: tuple[int, int],
        *,
        objects: Sequence[Surface] = (),
        yaw: float = 0.0,
    ) -> Pixels:
        """Return a skin (v, 3) in the world, mm, with objects half transparent before it.

        ``size`` is (width, height); ``yaw`` is 0 for a look from the front, :data:`THREE_QUARTER`
        for one from the side.
        """
        body = self._head.body(self._head.lit(skin, light))
        shown = [body, *(_glass(each) for each in objects)]
        return faded(render(shown, self._cameras[yaw], *size))


@dataclass(frozen=True)
class Shot:
    """A moment of an animation: its ``caption``, skin (v, 3) and objects in the world, mm."""

    caption: str
    skin: Floats
    objects: tuple[Surface, ...] = ()


def contact_sheet(
    filming: Filming, shots: Sequence[Shot], title: str, detail: str, path: Path
) -> None:
    """Draw shots in rows of :data:`COLUMNS`, each from the front and from the side."""
    width, height = CELL
    columns = min(COLUMNS, len(shots))
    rows = -(-len(shots) // columns)
    page = Page(2 * MARGIN + columns * width, HEADER + rows * (2 * height + 30) + MARGIN)
    page.heading(title, detail)
    for number, shot in enumerate(shots):
        left = MARGIN + number % columns * width
        top = HEADER + number // columns * (2 * height + 30)
        page.text((left + width // 2, top), shot.caption, 17, anchor="ma")
        light = filming.light(shot.skin)
        for row, yaw in enumerate((0.0, THREE_QUARTER)):
            image = filming.picture(shot.skin, light, CELL, objects=shot.objects, yaw=yaw)
            page.panel((left, top + 30 + row * height), image)
    page.save(path)


def _glass(surface: Surface) -> Body:
    return Body(Lit(surface), np.tile(OBJECT, (len(surface.vertices), 1)), opacity=OBJECT_OPACITY)
