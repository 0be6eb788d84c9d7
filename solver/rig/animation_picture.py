"""An animation's frames as pictures, with what the face meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.drawing.head import DrawnHead
from solver.drawing.render import DrawnBody, Lit, Pixels, fade, render
from solver.drawing.sheet import MARGIN, Column, SheetLayout, draw_sheet
from solver.model import SubjectModel
from solver.rig.edit_report import EditedPerson
from solver.rig.motion import SequenceFrame
from solver.rig.pictures import SIDE, THREE_QUARTER, face_camera
from solver.surface import Floats, Surface

# linear colour and opacity of what the face meets
OBJECT, OBJECT_OPACITY = (0.35, 0.45, 0.52), 0.3


class Filming:
    """Draws a subject's skins, one like the other: all from where the neutral is seen."""

    def __init__(self, model: SubjectModel) -> None:
        self._head = DrawnHead(model.skin)
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
        return fade(render(shown, self._cameras[yaw], *size))


@dataclass(frozen=True)
class Shot:
    """A moment of an animation: its ``caption``, skin (v, 3) and objects in the world, mm."""

    caption: str
    skin: Floats
    objects: tuple[Surface, ...] = ()


def contact_sheet(
    filming: Filming, shots: Sequence[Shot], title: str, detail: str, path: Path
) -> None:
    """Draw shots in rows of four, each from the front and from the side."""
    layout = SheetLayout(cell=(300, 360), label=MARGIN, columns=4, foot=MARGIN)
    columns = []
    for shot in shots:
        light = filming.light(shot.skin)
        images = [
            filming.picture(shot.skin, light, layout.cell, objects=shot.objects, yaw=yaw)
            for yaw in (0.0, THREE_QUARTER)
        ]
        columns.append(Column(shot.caption, images))
    draw_sheet(path, title, detail, ("", ""), columns, layout, scale_mm=None)


def _glass(surface: Surface) -> DrawnBody:
    return DrawnBody(
        Lit(surface), np.tile(OBJECT, (len(surface.vertices), 1)), opacity=OBJECT_OPACITY
    )


# A sheet of an edited person: before, after, and how far the skin has moved.


@dataclass(frozen=True)
class EditSheetOptions:
    """Amount of an edited person that a sheet shows."""

    expressions: int = 4  # columns beside those at rest, at most
    # ends of the colours' scale: the least that holds nearly all of the motion
    scales_mm: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0)
    nearly_all: float = 99.5  # percent of the face's vertices


View = tuple[str, float, Floats, Floats]


def edit_picture(
    person: EditedPerson,
    title: str,
    detail: str,
    path: Path,
    options: EditSheetOptions = EditSheetOptions(),
) -> None:
    """Draw the person at rest from three sides and in up to four expressions, in columns.

    Where there are more, or some found no rest, the heading says how many are shown.
    """
    views = [*_rest_views(person), *_expression_views(person)[: options.expressions]]
    shown, there = len(views) - len(_rest_views(person)), len(person.expressions)
    if shown < there:
        detail = f"{detail}; {shown} of {there} expressions are shown"
    moved = [np.linalg.norm(after - before, axis=1) for _, _, before, after in views]
    model = person.unedited
    most = _scale_end(np.concatenate([each[model.face] for each in moved]), options)
    head_before, head_after = DrawnHead(model.skin), DrawnHead(person.edited.model.skin)
    layout = SheetLayout()
    columns = []
    for (name, yaw, before, after), motion in zip(views, moved, strict=True):
        solved = head_after.lit(after)
        bodies = (
            head_before.body(head_before.lit(before)),
            head_after.body(solved),
            head_after.heat_map(solved, motion, most),
        )
        camera = face_camera(model.skin.vertices, model.face, yaw)
        columns.append(
            Column(name, [fade(render([body], camera, *layout.cell)) for body in bodies])
        )
    draw_sheet(path, title, detail, ("Before", "After", "Moved"), columns, layout, most)


def _rest_views(person: EditedPerson) -> list[View]:
    """Return name, camera's angle and skins before and after of the columns at rest."""
    before, after = person.before.skin, person.after.skin
    return [
        ("at rest", 0.0, before, after),
        ("three quarters", THREE_QUARTER, before, after),
        ("left side", SIDE, before, after),
    ]


def _expression_views(person: EditedPerson) -> list[View]:
    """Return the same of every expression that was found before and after."""
    return [
        (each.name.replace("_", " "), 0.0, each.before.skin, each.after.skin)
        for each in person.expressions
        if each.before is not None and each.after is not None
    ]


def _scale_end(moved_mm: Floats, options: EditSheetOptions) -> float:
    usual = np.percentile(moved_mm, options.nearly_all)
    return next((end for end in options.scales_mm if end >= usual), options.scales_mm[-1])


# A contact sheet of a sequence: some of its frames as seen, as fitted, and the error.


@dataclass(frozen=True)
class SequenceShot:
    """A fitted frame on the scan topology: ``seen`` and ``skin`` (v, 3), and ``error_mm`` (v,).

    ``error_mm`` is NaN where nothing was seen; there ``seen`` is the fitted skin.
    """

    frame: SequenceFrame
    seen: Floats
    skin: Floats
    error_mm: Floats


def sequence_picture(
    model: SubjectModel, shots: Sequence[SequenceShot], title: str, detail: str, path: Path
) -> None:
    """Draw the frames in columns: seen, fitted, error in mm; heads without their motion."""
    head = DrawnHead(model.skin)
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    layout = SheetLayout()
    columns = []
    for shot in shots:
        solved = head.lit(shot.skin)
        bodies = (
            head.body(head.lit(shot.seen)),
            head.body(solved),
            head.heat_map(solved, shot.error_mm),
        )
        images = [fade(render([body], camera, *layout.cell)) for body in bodies]
        caption = f"frame {shot.frame.frame}, mean {shot.frame.mean_mm:.2f} mm"
        columns.append(Column(caption, images))
    draw_sheet(path, title, detail, ("Seen", "Fit", "Error"), columns, layout)
