"""Fits of one scan by several models, side by side: what each makes of it and how far it is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.drawing.head import THREE_QUARTER, DrawnHead, face_camera
from solver.drawing.render import DrawnBody, render_bust
from solver.drawing.sheet import HEADER, Sheet
from solver.fitting.face import Face, PosedFace
from solver.rig.pictures import WIDTH
from solver.surface import Floats

FOOTER = 64
YAW = THREE_QUARTER / 2.0


@dataclass(frozen=True)
class Compared:
    """A scan (v, 3) in the skin's topology, mm, NaN where it shows nothing; its fits by name."""

    scan: Floats
    fits: Mapping[str, PosedFace]


def side_by_side(path: Path, face: Face, title: str, rows: Mapping[str, Compared]) -> None:
    """Draw a row for each expression: the scan, and every fit with its distance in mm.

    All rows have the same fits, ``S`` and ``P`` for example, in the same order.
    """
    model = face.model
    head = DrawnHead(model.skin)
    fits = list(next(iter(rows.values())).fits)
    columns = 1 + 2 * len(fits)
    cell = (WIDTH // columns, WIDTH // columns * 9 // 8)
    page = Sheet(WIDTH, HEADER + len(rows) * cell[1] + FOOTER)
    page.text((24, 16), title, 30)
    for column, name in enumerate(["Scan", *(text for fit in fits for text in (fit, ""))]):
        page.text((column * cell[0] + cell[0] // 2, HEADER - 24), name, 20, anchor="ma")
    for row, (name, compared) in enumerate(rows.items()):
        bodies, captions = _row(head, face, compared)
        top = HEADER + row * cell[1]
        for column, (body, caption) in enumerate(zip(bodies, [name, *captions], strict=True)):
            left = column * cell[0]
            camera = face_camera(model.skin.vertices, model.face, YAW)
            page.panel((left, top), render_bust([body], camera, cell))
            page.text((left + cell[0] // 2, top + cell[1] - 22), caption, 15, anchor="ma")
    page.scale((WIDTH - cell[0] - 80, HEADER + len(rows) * cell[1] + 12), cell[0])
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)


def _row(head: DrawnHead, face: Face, compared: Compared) -> tuple[list[DrawnBody], list[str]]:
    """Return the bodies of a row, and the captions of all but the first."""
    bodies = [head.body(head.lit(compared.scan))]
    captions = []
    for state in compared.fits.values():
        skin = face.whole_skin(state.x, state.pose.b)
        error = np.full(len(skin), np.nan)
        ids = face.model.face
        error[ids] = np.linalg.norm(skin[ids] - compared.scan[ids], axis=1)
        solved = head.lit(skin)
        bodies += [head.body(solved), head.heat_map(solved, error)]
        captions += ["", f"mean {np.nanmean(error):.2f} mm"]
    return bodies, captions
