"""The picture of a check: the face with its markers, and a lane for every label."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.drawing.render import Camera, DrawnBody, Lit, render
from solver.drawing.sheet import HEADER, MARGIN, Sheet
from solver.errors import quote
from solver.registration.search import nose_tip
from solver.scans.markers.checks.findings import MarkerCheck
from solver.scans.markers.places.face_take import LocatedTake
from solver.scans.markers.signal.faults import Faults
from solver.surface import Floats, Surface, vertex_normals

Colour = tuple[float, ...]

WIDTH, HEIGHT = 430, 560  # pixels of a view
YAWS = (0.0, np.radians(55))  # of the views
SPAN_MM, BACK_MM = 250.0, 55.0  # height of a view, and its middle behind the tip of the nose
LANES, LANE, NAMES = 620, 13, 150  # pixels: a lane's width and height, room for its name
LEAST_FACING = 0.15  # cosine: a marker that is seen more from the side is not drawn
NAME = (62, 9)  # pixels about a name in which no other is written
SKIN = np.array([0.62, 0.60, 0.58])
SEEN: Colour = (0.20, 0.55, 0.33)  # of markers without a fault
FAULTS: dict[str, tuple[str, Colour]] = {  # later ones are drawn over earlier ones
    "filled": ("filled in", (0.55, 0.78, 0.92)),
    "moved": ("sits elsewhere", (0.30, 0.42, 0.85)),
    "frozen": ("frozen", (0.55, 0.35, 0.70)),
    "outlier": ("thrown off", (0.86, 0.12, 0.14)),
    "ghost": ("another thing", (0.60, 0.10, 0.35)),
    "swapped": ("swapped", (0.95, 0.60, 0.10)),
    "relabelled": ("in another's place", (0.80, 0.70, 0.10)),
    "missing": ("missing", (0.84, 0.84, 0.85)),
}


def check_picture(check: MarkerCheck, face: Surface, title: str, path: Path) -> None:
    """Write the picture of a check as PNG; without a face in the take it holds only the title."""
    located = check.located
    names = [] if located is None else list(located.face.labels)
    rows = max(HEIGHT, LANE * len(names))
    legend = {"seen": SEEN, **dict(FAULTS.values())}
    width = WIDTH * len(YAWS) + NAMES + LANES + 2 * MARGIN
    page = Sheet.with_legend(title, _detail(check), legend, width, HEADER + rows + 36)
    if located is not None:
        colours = _colours(located.faults)
        if located.places is not None:
            for number, yaw in enumerate(YAWS):
                _draw_face(page, face, located.places, names, colours, yaw, WIDTH * number)
        _draw_lanes(page, located, WIDTH * len(YAWS) + NAMES)
    page.save(path)


def _detail(check: MarkerCheck) -> str:
    figures = check.figures
    words = [f"{figures.get('markers', 0)} markers", f"{figures.get('frames', 0)} frames"]
    if figures.get("rate"):
        words.append(f"{figures['rate']:g} a second")
    if "neutral" in figures:
        words.append("neutral: frames {} to {}".format(*figures["neutral"]))
    if "off_skin_mm" in figures:
        words.append(f"{figures['off_skin_mm']:.1f} mm off the skin")
    return ", ".join(words)


def _colours(faults: Faults) -> list[Colour]:
    """Return a colour for each marker: of the last of its faults in :data:`FAULTS`, but gaps."""
    found = [SEEN] * faults.usable.shape[1]
    for fault, (_, colour) in FAULTS.items():
        for span in faults.of(fault):
            if fault not in ("missing", "filled"):
                found[span.marker] = colour
    return found


def _draw_face(
    page: Sheet,
    face: Surface,
    placed: Floats,
    names: list[str],
    colours: list[Colour],
    yaw: float,
    left: int,
) -> None:
    centre = nose_tip(face) - np.array([0.0, 0.0, BACK_MM])
    camera = Camera(centre, SPAN_MM, yaw)
    light = 0.35 + 0.65 * camera.brightness(vertex_normals(face))
    lit = Lit(face, np.repeat(light[:, None], 3, axis=1))
    body = DrawnBody(lit, np.tile(SKIN, (len(light), 1)))
    page.panel((left, HEADER), render([body], camera, WIDTH, HEIGHT))
    pixels = camera.project(np.nan_to_num(placed), WIDTH, HEIGHT)
    backward = vertex_normals(face)[np.argmin(_squares(placed, face.vertices), axis=1)]
    written: list[tuple[int, int]] = []
    is_good = np.array([colour == SEEN for colour in colours])
    for number in np.lexsort((pixels[:, 2], is_good)).tolist():  # names of the odd ones first
        column, row, _ = pixels[number]
        is_inside = 0 < row < HEIGHT and 0 < column < WIDTH
        is_hidden = backward[number] @ camera.axes[2] < LEAST_FACING
        if np.isnan(placed[number, 0]) or is_hidden or not is_inside:
            continue
        x, y = left + round(column), HEADER + round(row)
        fill = tuple(round(255 * value) for value in colours[number])
        page.draw.ellipse([x - 5, y - 5, x + 5, y + 5], fill=fill, outline=(30, 30, 30))
        if all(abs(x - a) > NAME[0] or abs(y - b) > NAME[1] for a, b in written):
            page.text((x + 7, y - 6), quote(names[number])[:14], 10)
            written.append((x, y))


def _squares(points: Floats, vertices: Floats) -> Floats:
    """Return squared distances (k, n), 0 for what is not seen."""
    known = np.nan_to_num(points)
    return np.asarray(
        (known**2).sum(axis=1)[:, None] - 2 * known @ vertices.T + (vertices**2).sum(axis=1)
    )


def _draw_lanes(page: Sheet, located: LocatedTake, left: int) -> None:
    """Draw when each label is seen and what is wrong with it, the take from left to right."""
    faults, names = located.faults, located.face.labels
    frames = len(faults.usable)
    tall = LANE - 3

    def bar(row: int, first: int, last: int, colour: Colour) -> None:
        x, y = left + LANES * first // frames, HEADER + LANE * row
        end = max(x + 1, left + LANES * (last + 1) // frames)  # a frame is seen, too
        fill = tuple(round(255 * value) for value in colour)
        page.draw.rectangle([x, y, end, y + tall], fill=fill)

    for row, name in enumerate(names):
        page.text((left - 8, HEADER + LANE * row + tall // 2), quote(name)[:20], 10, anchor="rm")
        bar(row, 0, frames - 1, SEEN)
    for fault, (_, colour) in FAULTS.items():
        for span in faults.of(fault):
            bar(span.marker, span.first, span.last, colour)
    first, last = located.neutral
    x, end = (left + LANES * row // frames for row in (first, last + 1))
    y = HEADER + LANE * len(names) + 3
    page.draw.rectangle([x, y, end, y + 4], fill=(40, 40, 40))
    page.text(((x + end) // 2, y + 8), "neutral", 10, anchor="ma")
