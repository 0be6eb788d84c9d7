"""Contact sheet: columns of images under captions, in named rows, over a colour scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from solver.drawing.head import HEAT_MAX_MM
from solver.drawing.page import GREY, HEADER, MARGIN, Sheet
from solver.drawing.render import Pixels

CAPTION = 30  # pixels over every column


@dataclass(frozen=True)
class Column:
    """A caption and the images (h, w, 3) under it, one a row."""

    caption: str
    images: Sequence[Pixels]


@dataclass(frozen=True)
class SheetLayout:
    """Sizes in pixels: ``cell`` (width, height) of an image, ``label`` width of the rows' names.

    ``columns`` is how many stand side by side before the next begin below; ``foot`` is the room
    for the scale and the ``notes`` (lines beside it).
    """

    cell: tuple[int, int] = (270, 330)
    label: int = 90
    columns: int = 64
    foot: int = 64
    notes: tuple[str, ...] = ()


def draw_sheet(
    path: Path,
    title: str,
    detail: str,
    rows: Sequence[str],
    columns: Sequence[Column],
    layout: SheetLayout,
    scale_mm: float | None = HEAT_MAX_MM,
) -> None:
    """Draw ``columns`` of one image a row; the colours end at ``scale_mm`` (None: no scale)."""
    width, height = layout.cell
    across = min(layout.columns, len(columns))
    block = CAPTION + len(rows) * height
    blocks = -(-len(columns) // across)
    foot = HEADER + blocks * block
    page = Sheet(layout.label + across * width + MARGIN, foot + layout.foot)
    page.heading(title, detail)
    for number, column in enumerate(columns):
        left, top = layout.label + number % across * width, HEADER + number // across * block
        page.text((left + width // 2, top), column.caption, 17, anchor="ma")
        for row, image in enumerate(column.images):
            page.panel((left, top + CAPTION + row * height), image)
    for row, name in enumerate(rows):
        page.text((MARGIN, HEADER + CAPTION + row * height + height // 2), name, 17)
    if scale_mm is not None:
        page.scale((layout.label + 20, foot + 12), min(4, across) * width - 60, scale_mm)
    for line, words in enumerate(layout.notes):
        page.text((layout.label, foot + 60 + 20 * line), words, 14, GREY)
    page.save(path)
