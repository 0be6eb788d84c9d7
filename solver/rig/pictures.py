"""Pictures of a fit, of the anatomy and of the tets, drawn without a window system or a GPU."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.drawing.head import (
    COLOURS,
    SIDE,
    THREE_QUARTER,
    DrawnHead,
    both_sides,
    face_camera,
    linear,
    muscle_colours,
)
from solver.drawing.render import GAMMA, Camera, DrawnBody, Lit, render, render_bust
from solver.drawing.sheet import HEADER, INK, MARGIN, Colour, Column, Sheet, SheetLayout, draw_sheet
from solver.model import SubjectModel
from solver.rig.expression import ROLES, ExpressionFit
from solver.rig.frames import SequenceFrame
from solver.surface import (
    Floats,
    Ints,
    Surface,
    join_surfaces,
    own_numbers,
    unit_rows,
    vertex_normals,
)


@dataclass(frozen=True)
class ThreadOptions:
    """Length and thickness of the threads that show fibres."""

    least_share: float = 0.1  # a thread runs through each tet of which the muscle has this share
    step_mm: float = 1.0  # a thread follows the fibres so far at a time
    steps: int = 4  # so often, both ways
    radius_mm: float = 0.35
    neighbours: int = 6  # tets whose fibres a step follows, on average
    sides: int = 3  # of a tube


def fibre_threads(
    model: SubjectModel, options: ThreadOptions = ThreadOptions()
) -> dict[str, Surface]:
    """Return muscle -> thin tubes along its fibres, in mm.

    Muscles without a tet of ``least_share`` are left out, and all if the model has no fibres.
    """
    if model.fibres is None:
        return {}
    entries = model.weights.tocoo()
    points = model.tet_centres[entries.row]
    threads = {}
    for column, name in enumerate(model.muscle_names, start=1):
        own = (entries.col == column) & (entries.data >= options.least_share)
        if own.any():
            threads[name] = tubes(_trace(points[own], model.fibres[own], options), options)
    return threads


def _trace(points: Floats, directions: Floats, options: ThreadOptions) -> Floats:
    """Return polylines (k, 2 steps + 1, 3) through the points of a field."""
    tree = cKDTree(points)
    nearest = range(1, min(options.neighbours, len(points)) + 1)

    def follow(step_mm: float) -> list[Floats]:
        line = [points]
        for _ in range(options.steps):
            ahead = unit_rows(directions[tree.query(line[-1], k=nearest)[1]].mean(axis=1))
            line.append(line[-1] + step_mm * ahead)
        return line[1:]

    back = follow(-options.step_mm)
    forth = follow(options.step_mm)
    return np.stack([*back[::-1], points, *forth], axis=1)


def tubes(lines: Floats, options: ThreadOptions) -> Surface:
    """Return triangles around polylines (k, s, 3), thinner towards both ends."""
    count, steps, _ = lines.shape
    sides = options.sides
    along = unit_rows(np.gradient(lines, axis=1))
    across = unit_rows(np.cross(along, np.eye(3)[np.abs(along).argmin(axis=2)]))
    other = np.cross(along, across)
    width = options.radius_mm * np.sin(np.linspace(0.15, np.pi - 0.15, steps)) ** 0.5
    angle = 2 * np.pi * np.arange(sides) / sides
    cosine = np.cos(angle)[:, None]
    sine = np.sin(angle)[:, None]
    circle = cosine * across[:, :, None] + sine * other[:, :, None]
    vertices = lines[:, :, None] + width[:, None, None] * circle
    number: Ints = np.arange(count * steps * sides).reshape(count, steps, sides)
    a = number[:, :-1]
    b = number[:, 1:]
    after_a = np.roll(a, -1, axis=2)
    after_b = np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, after_a, after_b], -1), np.stack([a, after_b, b], -1)])
    return Surface(vertices.reshape(-1, 3), faces.reshape(-1, 3))


WIDTH = 1600  # pixels of a picture
VIEW_HEIGHT = 640  # pixels of a view of the anatomy
SECTION = np.radians(62.0)  # the camera's angle to a section through the tets


def fit_picture(model: SubjectModel, fit: ExpressionFit, path: Path) -> None:
    """Draw scan, fit and error (mm, on ``model.face``) side by side, from two cameras.

    Without a scan the skin at rest and the fit alone are drawn.
    """
    error = fit.measured_error(model.face)
    head = DrawnHead(model.skin)
    if len(error):
        bodies = head.compare(fit.target, fit.skin, fit.error_mm)
        titles = ["Scan", "Fit", "Error"]
        detail = (
            f"mean {error.mean():.2f} mm    95 % below {np.percentile(error, 95):.2f} mm    "
            f"greatest {error.max():.2f} mm"
        )
    else:
        bodies = [head.body(head.lit(each)) for each in (model.skin.vertices, fit.skin)]
        titles = ["At rest", "Fit"]
        detail = "there is no scan to compare it with"
    cell = width, height = WIDTH // 3, 520
    foot = HEADER + 2 * height
    page = Sheet(WIDTH, foot + 64)
    role = f"{ROLES[fit.role]} expression" if fit.role in ROLES else fit.role
    page.heading(fit.name.replace("_", " "), f"{role}    {detail}")
    cameras = [face_camera(model.skin.vertices, model.face, yaw) for yaw in (0.0, THREE_QUARTER)]
    for column, (title, body) in enumerate(zip(titles, bodies, strict=True)):
        images = [render_bust([body], camera, cell) for camera in cameras]
        page.column((column * width, HEADER), title, images, 20, above=0)
    if len(error):
        page.scale((WIDTH - width + 60, foot + 12), width - 130)
    page.save(path)


@dataclass(frozen=True)
class _Anatomy:
    """Parts in a picture of an anatomy; ``middle`` is the x of the plane between the sides."""

    skin: Surface
    face: Ints
    bones: dict[str, Surface]
    muscles: dict[str, Surface]
    middle: float

    @classmethod
    def of(cls, model: SubjectModel, muscles: dict[str, Surface]) -> _Anatomy:
        return cls(model.skin, model.face, model.bones, muscles, float(model.jaw.origin[0]))


def anatomy_picture(model: SubjectModel, path: Path) -> None:
    """Draw bones and muscles inside the skin: half cut open, and through transparent skin."""
    detail = f"{model.muscle_count} muscles, {len(model.tets)} tets, {len(model.rest)} vertices"
    _draw_anatomy(_Anatomy.of(model, model.muscle_surfaces), path, "Anatomy", detail)


def fibres_picture(model: SubjectModel, path: Path) -> None:
    """Draw the muscles' fibres over the bones, as :func:`anatomy_picture` draws the muscles."""
    detail = "each thread lies along the fibres of the muscle of its colour, which pulls that way"
    _draw_anatomy(_Anatomy.of(model, fibre_threads(model)), path, "Fibres", detail)


def template_picture(template: Template, path: Path) -> None:
    """Draw bones and muscles inside a template's skin, as :func:`anatomy_picture` does."""
    anatomy = _Anatomy(
        template.skin,
        template.face_vertices,
        {"cranium": template.cranium, "mandible": template.mandible},
        {muscle.name: muscle.surface for muscle in template.muscles},
        float(template.condyles[:, 0].mean()),
    )
    title = f"Template {template.name} {template.version}"
    detail = f"{len(template.muscles)} muscles, {len(template.skin.vertices)} skin vertices"
    _draw_anatomy(anatomy, path, title, detail)


def _draw_anatomy(anatomy: _Anatomy, path: Path, title: str, detail: str) -> None:
    palette = muscle_colours(tuple(anatomy.muscles))
    head = DrawnHead(anatomy.skin)
    lit = head.lit(anatomy.skin.vertices)
    inside = _inside(anatomy, palette, head.body(lit, np.vstack([head.eyes, head.teeth])))
    glass = head.body(lit, head.skin, opacity=0.1)
    is_right = lit.surface.vertices[lit.surface.faces, 0].mean(axis=1) < anatomy.middle
    right_half = head.body(lit, lit.surface.faces[is_right])
    views = [
        ("front, left half of the skin removed", 0.0, [inside, glass, right_half]),
        ("three quarters", THREE_QUARTER, [inside, glass]),
        ("left side", SIDE, [inside, glass]),
    ]
    _draw_views(path, title, detail, palette, (anatomy.skin.vertices, anatomy.face), views)


def tets_picture(model: SubjectModel, path: Path) -> None:
    """Draw sections through the tets, coloured by the muscle with the greatest share in each."""
    palette = muscle_colours(model.muscle_names)
    colour = _tet_colours(model, palette)
    centre = model.tet_centres - model.jaw.origin
    front = model.skin.vertices[model.face, 2].max() - model.jaw.origin[2]
    views = [
        ("all tets", 0.0, np.full(len(centre), True)),
        ("section left of the middle", SECTION, centre[:, 0] < 14.0),
        ("section half way to the jaw joint", 0.0, centre[:, 2] < 0.55 * front),
    ]
    detail = (
        f"{len(model.tets)} tets, {len(model.rest)} vertices; colour: muscle with the greatest "
        "share, fat where none has any"
    )
    fat: Colour = tuple(value ** (1 / GAMMA) for value in COLOURS["fat"])
    legend = {**palette, "fat and passive flesh": fat}
    shown = [(title, yaw, [_tet_body(model, keep, colour)]) for title, yaw, keep in views]
    _draw_views(path, "Tetrahedra", detail, legend, (model.skin.vertices, model.face), shown)


def _draw_views(
    path: Path,
    title: str,
    detail: str,
    legend: dict[str, Colour],
    face: tuple[Floats, Ints],
    views: list[tuple[str, float, list[DrawnBody]]],
) -> None:
    """Draw views of a ``face``, each a name, the camera's angle and bodies, over a legend."""
    page = Sheet.with_legend(title, detail, legend, WIDTH, HEADER + VIEW_HEIGHT + 48)
    width = WIDTH // len(views)
    for column, (name, yaw, bodies) in enumerate(views):
        image = render_bust(bodies, face_camera(*face, yaw), (width, VIEW_HEIGHT))
        page.panel((column * width, HEADER), image)
        page.text((column * width + width // 2, HEADER + VIEW_HEIGHT + 6), name, 17, anchor="ma")
    page.save(path)


def _inside(anatomy: _Anatomy, palette: dict[str, Colour], organs: DrawnBody) -> DrawnBody:
    """Return bones, muscles, and the eyes and teeth of ``organs`` as one body."""
    used, own = own_numbers(organs.drawn.faces)
    eyes_and_teeth = Surface(organs.drawn.vertices[used], own)
    pieces = [eyes_and_teeth, *anatomy.bones.values(), *anatomy.muscles.values()]
    bones = [np.array(COLOURS["bone"])] * len(anatomy.bones)
    muscles = [linear(np.array(palette[both_sides(name)])) for name in anatomy.muscles]
    colours = zip([organs.colour[used], *bones, *muscles], pieces, strict=True)
    colour = [np.broadcast_to(each, piece.vertices.shape) for each, piece in colours]
    return DrawnBody(Lit(join_surfaces(pieces)), np.vstack(colour))


def _tet_colours(model: SubjectModel, palette: dict[str, Colour]) -> Floats:
    """Return the linear colour (n, 3) of each tet: its main muscle's, paler with its share."""
    by_muscle = [palette[both_sides(name)] for name in model.muscle_names]
    shares = model.weights[:, 1:].tocsr()
    main = np.asarray(shares.argmax(axis=1)).ravel()
    passive = np.asarray(model.weights[:, [0]].todense())
    active = linear(np.array(by_muscle))[main]
    strength = np.where(passive < 1, 0.55 + 0.45 * (1 - passive), 0.0)
    return np.asarray(strength * active + (1 - strength) * np.array(COLOURS["fat"]))


def _tet_body(model: SubjectModel, keep: np.ndarray, colour: Floats) -> DrawnBody:
    """Return the outside of the kept tets, every triangle flat and in its tet's colour."""
    faces, owners, _ = igl.boundary_facets(model.tets[keep])
    corners = model.rest[faces].reshape(-1, 3)
    triangles: Ints = np.arange(len(corners)).reshape(-1, 3)
    shades = np.repeat(colour[keep][owners], 3, axis=0)
    return DrawnBody(Lit(Surface(corners, triangles)), shades, gloss=0.0, edges=True)


YAWS = (0.0, np.radians(55.0))  # of a template's skin


@dataclass(frozen=True)
class SkinSheetOptions:
    """Size of a picture of a skin with its landmarks, in pixels."""

    width: int = 1800
    height: int = 900  # of a view
    facing: float = 0.15  # landmarks on skin turned further away (cosine) are not drawn
    dot: int = 3  # radius of a landmark


def skin_picture(
    template: Template, path: Path, options: SkinSheetOptions = SkinSheetOptions()
) -> None:
    """Draw the skin from the front and the left, with a list of regions and landmarks."""
    # pale sRGB colours, hues by the golden ratio
    palette: dict[str, Colour] = {
        name: colorsys.hls_to_rgb((0.04 + number * 0.381966) % 1.0, 0.72, 0.55)
        for number, name in enumerate(template.regions)
    }
    ink: Colour = tuple(value / 255 for value in INK)
    marks = {f"{number}  {name}": ink for number, name in enumerate(template.landmarks, start=1)}
    title = f"Skin of template {template.name} {template.version}"
    detail = f"{len(template.regions)} regions, {len(template.landmarks)} landmarks"
    legend = {**palette, **marks}
    page = Sheet.with_legend(title, detail, legend, options.width, HEADER + options.height + MARGIN)
    head = DrawnHead(template.skin)
    vertices = template.skin.vertices
    dot = options.dot
    landmarks = np.array(list(template.landmarks.values()), np.int64)
    normals = vertex_normals(Surface(vertices, template.skin.faces[template.flesh_faces]))
    lit = head.lit(vertices)
    colour = head.body(lit).colour.copy()
    for name, region in template.regions.items():
        colour[region] = linear(np.array(palette[name]))
    face: Floats = vertices[template.face_vertices]
    low = face.min(axis=0)
    high = face.max(axis=0)
    size = width, _ = options.width // len(YAWS), options.height
    for column, yaw in enumerate(YAWS):
        camera = Camera((low + high) / 2, span=1.3 * float(high[1] - low[1]), yaw=yaw)
        corner = (column * width, HEADER)
        page.panel(corner, render([DrawnBody(lit, colour, gloss=0.0)], camera, *size))
        places = camera.project(vertices[landmarks], *size)[:, :2].round().astype(int)
        facing = normals[landmarks] @ camera.axes[2] > options.facing
        for number in np.flatnonzero(facing).tolist():
            x, y = (corner + places[number]).tolist()
            page.draw.ellipse([x - dot, y - dot, x + dot, y + dot], fill=INK)
            page.text((x + dot + 2, y), str(number + 1), 13, anchor="lm")
    page.save(path)


# A contact sheet of a sequence: some of its frames as seen, as fitted, and the error.


@dataclass(frozen=True)
class SequenceShot:
    """A fitted frame on the scan topology."""

    frame: SequenceFrame
    seen: Floats  # (v, 3) mm; where nothing was seen, the fitted skin
    skin: Floats  # (v, 3)
    error_mm: Floats  # (v,), NaN where nothing was seen


def sequence_picture(
    model: SubjectModel, shots: Sequence[SequenceShot], title: str, detail: str, path: Path
) -> None:
    """Draw the frames in columns: seen, fitted, error in mm; heads without their motion."""
    head = DrawnHead(model.skin)
    layout = SheetLayout()
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    columns = []
    for shot in shots:
        bodies = head.compare(shot.seen, shot.skin, shot.error_mm)
        caption = f"frame {shot.frame.frame}, mean {shot.frame.mean_mm:.2f} mm"
        columns.append(Column.of(caption, bodies, camera, layout))
    draw_sheet(path, title, detail, ("Seen", "Fit", "Error"), columns, layout)


# A contact sheet of muscle tracks: shapes as their template has them, and as flesh has them.


@dataclass(frozen=True)
class TrackShot:
    """A shape at weight 1, and the skin of flesh that goes there."""

    name: str
    shape: Floats  # (V, 3) mm
    skin: Floats | None  # (V, 3); None where the flesh found no rest
    inverted: int  # tets

    def off_mm(self, face: Ints) -> Floats:
        """Return the distances (k,) of the face's points; there must be a skin."""
        assert self.skin is not None, "a shape that was not reached has no distance"
        return np.asarray(np.linalg.norm((self.skin - self.shape)[face], axis=1))

    def figures(self, face: Ints) -> dict[str, Any]:
        """Return the figures for a report."""
        if self.skin is None:
            return {"name": self.name, "reached": False}
        off = self.off_mm(face)
        return {
            "name": self.name,
            "reached": True,
            "mean_mm": round(float(off.mean()), 4),
            "max_mm": round(float(off.max()), 4),
            "inverted": self.inverted,
        }


def tracks_picture(model: SubjectModel, shots: Sequence[TrackShot], path: Path) -> None:
    """Draw shapes in columns: the plain shape, the flesh under its tracks, the distance in mm."""
    head = DrawnHead(model.skin)
    layout = SheetLayout()
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    columns = []
    for shot in shots:
        if shot.skin is None:
            continue
        error = np.full(len(model.skin.vertices), np.nan)
        error[model.face] = shot.off_mm(model.face)
        bodies = head.compare(shot.shape, shot.skin, error)
        caption = f"{shot.name}, mean {np.nanmean(error):.2f} mm"
        columns.append(Column.of(caption, bodies, camera, layout))
    detail = "shapes at weight 1, and the flesh that muscles lead there"
    draw_sheet(path, "Muscle tracks", detail, ("Shape", "Tracks", "Error"), columns, layout)
