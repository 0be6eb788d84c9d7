"""Simulated and previewed skin of poses that the preview was not made from, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.drawing.head import Head
from solver.drawing.page import GREY, HEADER, Page
from solver.drawing.render import faded, render
from solver.model import SubjectModel
from solver.rig.pictures import face_camera
from solver.rig.preview.error import PreviewError
from solver.rig.preview.make import Preview

CELL, MARGIN, FOOTER = (330, 420), 110, 92
COLUMNS = 4
LEGEND = (
    "colour of the bottom row: distance between the two skins above it, mm",
    "grey: no part of the face, not compared",
    "plausible: a random pose of a few muscles; variation: an expression with one slider changed;",
    "blend: a mixture of two expressions; pair: two sliders that an expression moves together",
)


def preview_picture(model: SubjectModel, preview: Preview, path: Path) -> None:
    """Draw some unseen poses, from the middle one by their error to the worst."""
    unseen, neutral = preview.unseen, model.skin.vertices
    chosen = _chosen(unseen)
    overall = unseen.overall
    head = Head(model.skin)
    camera = face_camera(neutral, model.face, 0.0)
    page = Page(MARGIN + COLUMNS * CELL[0], HEADER + 3 * CELL[1] + FOOTER)
    page.heading(
        "Sliders on poses they were not made from",
        f"{overall.poses} poses    mean {overall.mean:.2f} mm    "
        f"95 % below {overall.p95:.2f} mm    greatest {overall.max:.2f} mm",
    )
    for row, title in enumerate(("Simulated", "Sliders", "Error, mm")):
        page.text((24, HEADER + row * CELL[1] + CELL[1] // 2), title, 17)
    for column, number in enumerate(chosen):
        sample = unseen.samples[number]
        shown = neutral + preview.skin.motion(sample.slid.values)
        error = np.full(len(neutral), np.nan)
        error[model.face] = unseen.off[number]
        simulated, previewed = head.lit(sample.skin), head.lit(shown)
        bodies = (head.body(simulated), head.body(previewed), head.heat_map(previewed, error))
        left = MARGIN + column * CELL[0]
        for row, body in enumerate(bodies):
            image = faded(render([body], camera, *CELL))
            page.panel((left, HEADER + row * CELL[1]), image)
        words = f"{sample.slid.sort}, mean {unseen.off[number].mean():.2f} mm"
        page.text((left + CELL[0] // 2, HEADER), words, 17, anchor="ma")
    foot = HEADER + 3 * CELL[1]
    page.scale((MARGIN + 60, foot + 12), CELL[0] + 100)
    for line, words in enumerate(LEGEND):
        page.text((MARGIN + 2 * CELL[0], foot + 2 + 20 * line), words, 14, GREY)
    page.save(path)


def _chosen(unseen: PreviewError) -> list[int]:
    """Return the numbers of the samples to draw, those of a control alone left out."""
    mixed = [row for row, sample in enumerate(unseen.samples) if sample.slid.sort != "alone"]
    order = sorted(mixed, key=lambda row: float(unseen.off[row].mean()))
    places = np.linspace(0.5, 1.0, COLUMNS) * (len(order) - 1)
    return list(dict.fromkeys(order[round(place)] for place in places)) if order else []
