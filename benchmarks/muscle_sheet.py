"""A sheet of single muscles: how far the skin goes, by colour, where to, by arrows, and its folds.

Folds are drawn as strokes along the skin's lines, square to where it is shortened most, as wrinkles
lie square to the fibres that make them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from solver.drawing.head import DrawnHead
from solver.drawing.render import Camera, render
from solver.drawing.sheet import GREY, HEADER, INK, Sheet
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface, unit_rows, vertex_normals

FOLD = (150, 20, 60)  # sRGB bytes


@dataclass(frozen=True)
class MuscleSheetOptions:
    """Sizes in pixels, and what is drawn of the skin."""

    cell: tuple[int, int] = (198, 198)
    colours: int = 128  # of the file: half the size
    caption: int = 68  # height, over a picture
    letters: int = 28  # in a line of it
    columns: int = 8
    span_mm: float = 120.0  # that a picture shows
    longest_mm: float = 14.0  # arrow, at the greatest motion
    spacing_mm: float = 9.0  # between arrows
    least: float = 0.2  # of the greatest motion, from which there is one
    fold: float = 0.95  # stretch of the skin below which it is folded
    fold_mm: float = 5.0  # half a stroke's length
    smooth_mm: float = 5.0  # over which stretches are averaged
    facing: float = 0.3  # cosine to the camera, below which nothing is drawn over the skin
    most_yaw: float = np.radians(60.0)


@dataclass(frozen=True)
class Pulled:
    """The skin (v, 3) in mm at rest and with a muscle pulled, and the flesh ``x`` (p, 3) then."""

    before: Floats
    after: Floats
    x: Floats

    @property
    def motion(self) -> Floats:
        """Return how far each vertex of the skin goes, (v, 3)."""
        return np.asarray(self.after - self.before)


def least_stretches(
    model: SubjectModel, pulled: Pulled, options: MuscleSheetOptions = MuscleSheetOptions()
) -> tuple[Floats, Floats]:
    """Return the least stretch (k,) of the skin in its plane at the face's points, and its lines.

    The lines (k, 3) lie square to the shortening. Deformation gradients are averaged over the
    points around, so that a single triangle is no fold.
    """
    points = pulled.before[model.face]
    moved = pulled.after[model.face]
    normals = vertex_normals(Surface(pulled.before, model.skin.faces))[model.face]
    stretch = np.full(len(points), np.nan)
    lines = np.zeros_like(points)
    tree = cKDTree(points)
    for point, near in enumerate(tree.query_ball_point(points, options.smooth_mm)):
        away = points[near] - points[point]
        gone = moved[near] - moved[point]
        frame = np.linalg.svd(np.eye(3) - np.outer(normals[point], normals[point]))[0][:, :2]
        flat = away @ frame
        if len(near) < 4 or np.linalg.matrix_rank(flat, tol=0.1) < 2:
            continue
        F = np.linalg.lstsq(flat, gone, rcond=None)[0].T
        values, axes = np.linalg.eigh(F.T @ F)
        stretch[point] = np.sqrt(max(values[0], 0.0))
        lines[point] = frame @ axes[:, 1]
    return stretch, lines


def draw(
    path: Path,
    title: str,
    model: SubjectModel,
    muscles: Mapping[str, Pulled],
    options: MuscleSheetOptions = MuscleSheetOptions(),
) -> None:
    """Draw a picture of every muscle under its name and greatest motion, as a PNG."""
    width, height = options.cell
    caption = options.caption
    rows = -(-len(muscles) // options.columns)
    page = Sheet(options.columns * width, HEADER + rows * (height + caption))
    detail = (
        "Contracted by 30 %, volume kept. Colour and arrows: up to the greatest motion, which is "
        f"written; strokes: folds, where skin is {100 * (1 - options.fold):.0f} % shorter and more"
    )
    page.heading(title, detail)
    head = DrawnHead(model.skin)
    for number, (name, pulled) in enumerate(muscles.items()):
        left = number % options.columns * width
        top = number // options.columns * (height + caption)
        _picture(page, (left, HEADER + top + caption), model, head, pulled, options)
        size = np.linalg.norm(pulled.motion[model.face], axis=1).max()
        lines = textwrap.wrap(name.replace("_", " ").replace(".", ", "), options.letters)
        for line, words in enumerate([*lines, f"{size:.1f} mm"]):
            ink = INK if line < len(lines) else GREY
            page.text((left + width // 2, HEADER + top + 16 * line), words, 13, ink, "ma")
    path.parent.mkdir(parents=True, exist_ok=True)
    page.image.quantize(options.colours).save(path, optimize=True)


def _picture(
    page: Sheet,
    corner: tuple[int, int],
    model: SubjectModel,
    head: DrawnHead,
    pulled: Pulled,
    options: MuscleSheetOptions,
) -> None:
    motion = pulled.motion
    size = np.linalg.norm(motion, axis=1)
    shown = size[model.face]
    points = pulled.after[model.face]
    normals = vertex_normals(Surface(pulled.after, model.skin.faces))[model.face]
    way = shown**2 @ normals
    yaw = float(np.clip(np.arctan2(way[0], way[2]), -options.most_yaw, options.most_yaw))
    camera = Camera(shown**2 @ points / (shown**2).sum(), options.span_mm, yaw=yaw)
    body = head.heat_map(head.lit(pulled.after), size, float(shown.max()))
    page.panel(corner, render([body], camera, *options.cell))
    stretch, lines = least_stretches(model, pulled, options)
    longer = options.longest_mm / shown.max()
    faces_us = normals @ camera.axes[2] > options.facing

    def stroke(begin: Floats, end: Floats, ink: tuple[int, int, int], *, arrow: bool) -> None:
        ends = camera.project(np.array([begin, end]), *options.cell)[:, :2]
        inside = (ends >= 0).all() and (ends < options.cell).all()
        if not inside:
            return
        ends += corner
        page.draw.line([tuple(ends[0]), tuple(ends[1])], fill=ink, width=1 if arrow else 2)
        if arrow:
            along = unit_rows(ends[1:] - ends[:1])[0]
            across = np.array([-along[1], along[0]])
            barbs = [ends[1] - 4 * along + side * 2.5 * across for side in (1, -1)]
            page.draw.polygon([tuple(ends[1]), *map(tuple, barbs)], fill=ink)

    folded = np.flatnonzero(faces_us & (stretch < options.fold))
    for point in _spaced(points, folded, stretch, options.spacing_mm):
        reach = 0.5 * options.fold_mm * lines[point]
        stroke(points[point] - reach, points[point] + reach, FOLD, arrow=False)
    moving = np.flatnonzero(faces_us & (shown > options.least * shown.max()))
    for point in _spaced(points, moving, -shown, options.spacing_mm):
        begin = pulled.before[model.face[point]]
        stroke(begin, begin + longer * motion[model.face[point]], INK, arrow=True)


def _spaced(points: Floats, chosen: Ints, order: Floats, spacing: float) -> list[int]:
    """Return those ``chosen`` in ``order`` that are not near one before them."""
    kept: list[int] = []
    for point in chosen[np.argsort(order[chosen])].tolist():
        if not kept or np.linalg.norm(points[kept] - points[point], axis=1).min() > spacing:
            kept.append(point)
    return kept
