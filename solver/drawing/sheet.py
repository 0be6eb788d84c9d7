"""Sheets of images with titles, captions and a colour scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from solver.drawing.head import HEAT_MAX_MM, heat
from solver.drawing.render import Camera, DrawnBody, Pixels, render_bust

# sRGB bytes
INK = (38, 40, 46)  # of titles
GREY = (112, 116, 124)  # of details
PAPER = (249, 249, 250)  # behind all
MARGIN = 24  # pixels left of text
HEADER = 84  # pixels above the first picture
SWATCH = 14  # pixels a side of a square of colour
CAPTION = 30  # pixels over every column
TITLE_SIZE = 30  # of its letters, pixels
DETAIL_SIZE = 17  # of other letters, pixels

Colour = tuple[float, ...]


class Sheet:
    """A page of a given size in pixels, on which the parts are placed by their corners."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (width, height), PAPER)
        self.draw = ImageDraw.Draw(self.image)

    @classmethod
    def with_legend(
        cls, title: str, detail: str, legend: dict[str, Colour], width: int, top: int
    ) -> Sheet:
        """Return a page with its heading, and named colours in columns from ``top`` on."""
        across = width - 2 * MARGIN
        columns = max(1, across // 300)
        rows = -(-len(legend) // columns)
        high = SWATCH + 9
        page = cls(width, top + rows * high + MARGIN)
        page.heading(title, detail)
        for number, (name, colour) in enumerate(legend.items()):
            x = MARGIN + number // rows * (across // columns)
            y = top + number % rows * high
            fill = tuple(round(255 * value) for value in colour)
            page.draw.rectangle([x, y, x + SWATCH, y + SWATCH], fill=fill)
            page.text((x + SWATCH + 8, y - 2), name, 15)
        return page

    def heading(self, title: str, detail: str) -> None:
        """Write the title and a line of figures across the top."""
        self.text((MARGIN, 16), title, TITLE_SIZE)
        self.text((MARGIN, 54), detail, DETAIL_SIZE, GREY)

    def text(
        self,
        place: tuple[int, int],
        words: str,
        size: int,
        ink: tuple[int, int, int] = INK,
        anchor: str = "la",
    ) -> None:
        """Write one line of text."""
        self.draw.text(place, words, fill=ink, font=ImageFont.load_default(size), anchor=anchor)

    def panel(self, place: tuple[int, int], pixels: Pixels) -> None:
        """Place an sRGB image (h, w, 3) with values in [0, 1]."""
        self.image.paste(Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)), place)

    def column(
        self,
        place: tuple[int, int],
        caption: str,
        images: Sequence[Pixels],
        size: int = 17,
        above: int = CAPTION,
    ) -> None:
        """Place images (h, w, 3) below one another, ``above`` pixels under a caption."""
        left, top = place
        height, width, _ = images[0].shape
        for row, image in enumerate(images):
            self.panel((left, top + above + row * height), image)
        self.text((left + width // 2, top), caption, size, anchor="ma")

    def scale(self, place: tuple[int, int], width: int, most_mm: float = HEAT_MAX_MM) -> None:
        """Draw a distance's colour scale with its millimetres."""
        left, top = place
        colour = heat(np.linspace(0, most_mm, width), most_mm)
        self.panel(place, np.broadcast_to(colour, (SWATCH, width, 3)).astype(np.float32))
        for mm in np.linspace(0, most_mm, 5):
            x = left + round((width - 1) * mm / most_mm)
            words = f"{mm:g} mm and more" if mm == most_mm else f"{mm:g}"
            self.draw.line([(x, top + SWATCH), (x, top + SWATCH + 4)], fill=GREY)
            self.text((x, top + SWATCH + 7), words, 15, GREY, "ma")

    def save(self, path: Path) -> None:
        """Write the page as PNG."""
        self.image.save(path)


# Contact sheets: columns of images under captions, in named rows, over a colour scale.


@dataclass(frozen=True)
class Column:
    """A caption and the images (h, w, 3) under it, one a row."""

    caption: str
    images: Sequence[Pixels]

    @classmethod
    def of(
        cls, caption: str, bodies: Sequence[DrawnBody], camera: Camera, layout: SheetLayout
    ) -> Column:
        """Return the pictures of bodies, each by itself."""
        return cls(caption, [render_bust([each], camera, layout.cell) for each in bodies])


@dataclass(frozen=True)
class SheetLayout:
    """Sizes of a sheet, in pixels."""

    cell: tuple[int, int] = (270, 330)  # width and height of an image
    label: int = 90  # width of the rows' names
    columns: int = 64  # side by side before the next begin below
    foot: int = 64  # room for the scale and the notes
    notes: tuple[str, ...] = ()  # lines below the scale


def draw_sheet(
    path: Path,
    title: str,
    detail: str,
    rows: Sequence[str],
    columns: Sequence[Column],
    layout: SheetLayout,
    scale_mm: float | None = HEAT_MAX_MM,
) -> None:
    """Draw ``columns``, one image a row; the scale ends at ``scale_mm`` (None: there is none)."""
    width, height = layout.cell
    across = min(layout.columns, len(columns))
    block = CAPTION + len(rows) * height
    blocks = -(-len(columns) // across)
    foot = HEADER + blocks * block
    heading = max(_length(title, TITLE_SIZE), _length(detail, DETAIL_SIZE))
    wide = max(layout.label + across * width, MARGIN + heading) + MARGIN
    page = Sheet(wide, foot + layout.foot)
    page.heading(title, detail)
    for number, column in enumerate(columns):
        left = layout.label + number % across * width
        top = HEADER + number // across * block
        page.column((left, top), column.caption, column.images)
    for row, name in enumerate(rows):
        page.text((MARGIN, HEADER + CAPTION + row * height + height // 2), name, 17)
    if scale_mm is not None:
        page.scale((layout.label + 20, foot + 12), min(4, across) * width - 60, scale_mm)
    for line, words in enumerate(layout.notes):
        page.text((layout.label, foot + 60 + 20 * line), words, 14, GREY)
    page.save(path)


def _length(words: str, size: int) -> int:
    """Return how many pixels a line of text is wide."""
    return math.ceil(ImageFont.load_default(size).getlength(words))
