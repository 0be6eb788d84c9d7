"""A sheet of an edited person: before, after, and how far the skin has moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.drawing.head import Head
from solver.drawing.page import HEADER, MARGIN, Page
from solver.drawing.render import faded, render
from solver.rig.edit_report import EditedPerson
from solver.rig.pictures import SIDE, THREE_QUARTER, face_camera
from solver.surface import Floats

CELL = (270, 330)
LEFT, FOOTER = 90, 64
VIEWS_AT_REST, MOST_EXPRESSIONS = 3, 4
MOST_MM = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Ends of the colour scale: the least that holds nearly all of the motion."""

View = tuple[str, float, Floats, Floats]


def edit_picture(person: EditedPerson, title: str, detail: str, path: Path) -> None:
    """Draw the person at rest from three sides and in up to four expressions, in columns.

    Where there are more, or some found no rest, the heading says how many are shown.
    """
    views = _views(person)
    shown, there = len(views) - VIEWS_AT_REST, len(person.expressions)
    if shown < there:
        detail = f"{detail}; {shown} of {there} expressions are shown"
    width, height = CELL
    page = Page(LEFT + width * len(views) + MARGIN, HEADER + 30 + 3 * height + FOOTER)
    page.heading(title, detail)
    for row, name in enumerate(("Before", "After", "Moved")):
        page.text((MARGIN, HEADER + 30 + row * height + height // 2), name, 20)
    moved = [np.linalg.norm(after - before, axis=1) for _, _, before, after in views]
    model = person.unedited
    most = _scale_end(np.concatenate([each[model.face] for each in moved]))
    head_before, head_after = Head(model.skin), Head(person.edited.model.skin)
    for column, (name, yaw, before, after) in enumerate(views):
        left = LEFT + column * width
        page.text((left + width // 2, HEADER), name, 17, anchor="ma")
        solved = head_after.lit(after)
        bodies = (
            head_before.body(head_before.lit(before)),
            head_after.body(solved),
            head_after.heat_map(solved, moved[column], most),
        )
        camera = face_camera(model.skin.vertices, model.face, yaw)
        for row, body in enumerate(bodies):
            image = faded(render([body], camera, width, height))
            page.panel((left, HEADER + 30 + row * height), image)
    page.scale((LEFT + 20, HEADER + 30 + 3 * height + 12), 3 * width - 60, most)
    page.save(path)


def _views(person: EditedPerson) -> list[View]:
    """Return name, camera's angle and skins before and after of every column."""
    before, after = person.before.skin, person.after.skin
    views = [
        ("at rest", 0.0, before, after),
        ("three quarters", THREE_QUARTER, before, after),
        ("left side", SIDE, before, after),
    ]
    for each in person.expressions:
        if each.before is not None and each.after is not None:
            name = each.name.replace("_", " ")
            views.append((name, 0.0, each.before.skin, each.after.skin))
    return views[: VIEWS_AT_REST + MOST_EXPRESSIONS]


def _scale_end(moved_mm: Floats) -> float:
    usual = np.percentile(moved_mm, 99.5)
    return next((end for end in MOST_MM if end >= usual), MOST_MM[-1])
