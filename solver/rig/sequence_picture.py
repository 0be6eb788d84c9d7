"""A contact sheet of a sequence: some of its frames as seen, as fitted, and the error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from solver.drawing.head import Head
from solver.drawing.page import HEADER, MARGIN, Page
from solver.drawing.render import faded, render
from solver.model import SubjectModel
from solver.rig.pictures import face_camera
from solver.rig.sequence import SequenceFrame
from solver.surface import Floats

CELL = (270, 330)
LEFT, FOOTER = 90, 64


@dataclass(frozen=True)
class Shot:
    """A fitted frame on the scan topology: ``seen`` and ``skin`` (v, 3), and ``error_mm`` (v,).

    ``error_mm`` is NaN where nothing was seen; there ``seen`` is the fitted skin.
    """

    frame: SequenceFrame
    seen: Floats
    skin: Floats
    error_mm: Floats


def sequence_picture(
    model: SubjectModel, shots: Sequence[Shot], title: str, detail: str, path: Path
) -> None:
    """Draw the frames in columns: seen, fitted, error in mm; heads without their motion."""
    head = Head(model.skin)
    width, height = CELL
    page = Page(LEFT + width * len(shots) + MARGIN, HEADER + 30 + 3 * height + FOOTER)
    page.heading(title, detail)
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    for row, name in enumerate(("Seen", "Fit", "Error")):
        page.text((MARGIN, HEADER + 30 + row * height + height // 2), name, 20)
    for column, shot in enumerate(shots):
        left = LEFT + column * width
        page.text(
            (left + width // 2, HEADER),
            f"frame {shot.frame.frame}, mean {shot.frame.mean_mm:.2f} mm",
            17,
            anchor="ma",
        )
        solved = head.lit(shot.skin)
        bodies = (
            head.body(head.lit(shot.seen)),
            head.body(solved),
            head.heat_map(solved, shot.error_mm),
        )
        for row, body in enumerate(bodies):
            image = faded(render([body], camera, width, height))
            page.panel((left, HEADER + 30 + row * height), image)
    page.scale((LEFT + 20, HEADER + 30 + 3 * height + 12), min(4 * width, width * len(shots)) - 60)
    page.save(path)
