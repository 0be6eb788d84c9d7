"""Pictures of a fit, of the anatomy and of the tets, drawn without a window system or a GPU."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.drawing.head import COLOURS, DrawnHead, both_sides, linear, muscle_colours
from solver.drawing.render import GAMMA, Camera, DrawnBody, Lit, fade, render
from solver.drawing.sheet import HEADER, INK, MARGIN, Colour, Sheet, swatch_columns, swatch_height
from solver.model import SubjectModel
from solver.rig.result import ROLES, ExpressionFit
from solver.surface import Floats, Ints, Surface, vertex_normals

# Short threads along the fibres of muscles, for pictures.


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
    centres = model.rest[model.tets].mean(axis=1)
    threads = {}
    for column, name in enumerate(model.muscle_names, start=1):
        own = np.flatnonzero((entries.col == column) & (entries.data >= options.least_share))
        if len(own):
            points = centres[entries.row[own]]
            threads[name] = _tubes(_trace(points, model.fibres[own], options), options)
    return threads


def _trace(points: Floats, directions: Floats, options: ThreadOptions) -> Floats:
    """Return polylines (k, 2 steps + 1, 3) through the points of a field."""
    tree = cKDTree(points)
    count = min(options.neighbours, len(points))
    halves = []
    for sign in (-1.0, 1.0):
        place, ahead, line = points, directions, []
        for _ in range(options.steps):
            near = tree.query(place, k=range(1, count + 1))[1]
            ahead = directions[near].mean(axis=1)
            ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
            place = place + sign * options.step_mm * ahead
            line.append(place)
        halves.append(line)
    return np.stack([*halves[0][::-1], points, *halves[1]], axis=1)


def _tubes(lines: Floats, options: ThreadOptions) -> Surface:
    """Return triangles around polylines (k, s, 3), thinner towards both ends."""
    count, steps, _ = lines.shape
    sides = options.sides
    along = np.gradient(lines, axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    least = np.eye(3)[np.abs(along).argmin(axis=2)]
    across = np.cross(along, least)
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    other = np.cross(along, across)
    width = options.radius_mm * np.sin(np.linspace(0.15, np.pi - 0.15, steps)) ** 0.5
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = (
        np.cos(angle)[:, None] * across[:, :, None] + np.sin(angle)[:, None] * other[:, :, None]
    )
    vertices = lines[:, :, None] + width[:, None, None] * circle
    number: Ints = np.arange(count * steps * sides).reshape(count, steps, sides)
    a, b = number[:, :-1], number[:, 1:]
    after_a, after_b = np.roll(a, -1, axis=2), np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, after_a, after_b], -1), np.stack([a, after_b, b], -1)])
    return Surface(vertices.reshape(-1, 3), faces.reshape(-1, 3))


WIDTH = 1600  # of a picture, pixels
THREE_QUARTER, SECTION, SIDE = np.radians(38.0), np.radians(62.0), np.radians(88.0)


def fit_picture(model: SubjectModel, fit: ExpressionFit, path: Path) -> None:
    """Draw scan, fit and error (mm, on ``model.face``) side by side, from two cameras."""
    error = fit.measured_error(model.face)
    head = DrawnHead(model.skin)
    scan, solved = head.lit(fit.target), head.lit(fit.skin)
    bodies = {
        "Scan": head.body(scan),
        "Fit": head.body(solved),
        "Error": head.heat_map(solved, fit.error_mm),
    }
    cell, footer = (WIDTH // 3, 520), 64
    page = Sheet(WIDTH, HEADER + 2 * cell[1] + footer)
    page.heading(
        fit.name.replace("_", " "),
        f"{_role_words(fit.role)}    mean {error.mean():.2f} mm    "
        f"95 % below {np.percentile(error, 95):.2f} mm    greatest {error.max():.2f} mm",
    )
    for column, (title, body) in enumerate(bodies.items()):
        left = column * cell[0]
        for row, yaw in enumerate((0.0, THREE_QUARTER)):
            image = fade(render([body], face_camera(model.skin.vertices, model.face, yaw), *cell))
            page.panel((left, HEADER + row * cell[1]), image)
        page.text((left + cell[0] // 2, HEADER), title, 20, anchor="ma")
    page.scale((WIDTH - cell[0] + 60, HEADER + 2 * cell[1] + 12), cell[0] - 130)
    page.save(path)


def _role_words(role: str) -> str:
    return f"{ROLES[role]} expression" if role in ROLES else role


@dataclass(frozen=True)
class _Anatomy:
    """Parts in a picture of an anatomy; ``middle`` is the x of the plane between the sides."""

    skin: Surface
    face: Ints
    bones: dict[str, Surface]
    muscles: dict[str, Surface]
    middle: float


def anatomy_picture(model: SubjectModel, path: Path) -> None:
    """Draw bones and muscles inside the skin: half cut open, and through transparent skin."""
    middle = float(model.jaw.origin[0])
    anatomy = _Anatomy(model.skin, model.face, model.bones, model.muscles, middle)
    detail = f"{model.muscle_count} muscles, {len(model.tets)} tets, {len(model.rest)} vertices"
    _draw_anatomy(anatomy, path, "Anatomy", detail)


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
    _views_with_legend(path, anatomy.skin.vertices, anatomy.face, views, title, detail, palette)


def fibres_picture(model: SubjectModel, path: Path) -> None:
    """Draw the muscles' fibres over the bones, as :func:`anatomy_picture` draws the muscles."""
    middle = float(model.jaw.origin[0])
    anatomy = _Anatomy(model.skin, model.face, model.bones, fibre_threads(model), middle)
    detail = "each thread lies along the fibres of the muscle of its colour, which pulls that way"
    _draw_anatomy(anatomy, path, "Fibres", detail)


def tets_picture(model: SubjectModel, path: Path) -> None:
    """Draw sections through the tets, coloured by the muscle with the greatest share in each."""
    palette = muscle_colours(model.muscle_names)
    colour = _tet_colours(model, palette)
    centre = model.rest[model.tets].mean(axis=1) - model.jaw.origin
    front = model.skin.vertices[model.face, 2].max() - model.jaw.origin[2]
    views = [
        ("all tets", 0.0, np.full(len(centre), True)),
        ("section left of the middle", SECTION, centre[:, 0] < 14.0),
        ("section half way to the jaw joint", 0.0, centre[:, 2] < 0.55 * front),
    ]
    shown = [(title, yaw, [_tet_body(model, keep, colour)]) for title, yaw, keep in views]
    _views_with_legend(
        path,
        model.skin.vertices,
        model.face,
        shown,
        "Tetrahedra",
        f"{len(model.tets)} tets, {len(model.rest)} vertices; colour: muscle with the greatest "
        "share, fat where none has any",
        {**palette, "fat and passive flesh": _srgb(COLOURS["fat"])},
    )


def _views_with_legend(
    path: Path,
    skin: Floats,
    face: Ints,
    views: list[tuple[str, float, list[DrawnBody]]],
    title: str,
    detail: str,
    legend: dict[str, Colour],
) -> None:
    cell = (WIDTH // len(views), 640)
    rows = -(-len(legend) // swatch_columns(WIDTH - 2 * MARGIN))
    page = Sheet(WIDTH, HEADER + cell[1] + 48 + rows * swatch_height() + MARGIN)
    page.heading(title, detail)
    for column, (name, yaw, bodies) in enumerate(views):
        image = fade(render(bodies, face_camera(skin, face, yaw), *cell))
        page.panel((column * cell[0], HEADER), image)
        place = (column * cell[0] + cell[0] // 2, HEADER + cell[1] + 6)
        page.text(place, name, 17, anchor="ma")
    page.swatches((MARGIN, HEADER + cell[1] + 48), legend, WIDTH - 2 * MARGIN)
    page.save(path)


def face_camera(skin: Floats, face: Ints, yaw: float) -> Camera:
    """Return a camera that shows the face with the head around it."""
    low, high = skin[face].min(axis=0), skin[face].max(axis=0)
    height = high[1] - low[1]
    centre = (low + high) / 2 + np.array([0.0, 0.06 * height, 0.0])
    head = skin[skin[:, 1] > low[1]]
    centre[2] = (head[:, 2].min() + head[:, 2].max()) / 2
    return Camera(centre, span=1.62 * height, yaw=yaw)


def _inside(anatomy: _Anatomy, palette: dict[str, Colour], organs: DrawnBody) -> DrawnBody:
    """Return bones, muscles, and the eyes and teeth of ``organs`` as one body."""
    used, numbers = np.unique(organs.drawn.faces, return_inverse=True)
    eyes_and_teeth = Surface(organs.drawn.vertices[used], numbers.reshape(-1, 3).astype(np.int64))
    pieces = [(eyes_and_teeth, organs.colour[used])]
    pieces += [(bone, np.array([COLOURS["bone"]])) for bone in anatomy.bones.values()]
    for name, muscle in anatomy.muscles.items():
        pieces.append((muscle, linear(np.array([palette[both_sides(name)]]))))
    counts = [len(piece.vertices) for piece, _ in pieces]
    starts = np.cumsum(counts) - counts
    surface = Surface(
        np.vstack([piece.vertices for piece, _ in pieces]),
        np.vstack([piece.faces + start for (piece, _), start in zip(pieces, starts, strict=True)]),
    )
    colour = [np.broadcast_to(colour, piece.vertices.shape) for piece, colour in pieces]
    return DrawnBody(Lit(surface), np.vstack(colour))


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
    tets = model.tets[keep]
    faces = tets[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    owner = np.repeat(np.flatnonzero(keep), 4)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outside = first[count == 1]
    corners = model.rest[faces[outside]].reshape(-1, 3)
    triangles: Ints = np.arange(len(corners)).reshape(-1, 3)
    shades = np.repeat(colour[owner[outside]], 3, axis=0)
    return DrawnBody(Lit(Surface(corners, triangles)), shades, gloss=0.0, edges=True)


def _srgb(colour: Colour) -> Colour:
    red, green, blue = (float(value) ** (1 / GAMMA) for value in colour)
    return red, green, blue


# A picture of a template's skin: its regions in colours, its landmarks by number.


VIEWS = (("front", 0.0), ("left", np.radians(55.0)))


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
    palette = _palette(list(template.regions))
    legend = {**palette, **_number_landmarks(template)}
    across = options.width - 2 * MARGIN
    rows = -(-len(legend) // swatch_columns(across))
    height = HEADER + options.height + MARGIN + rows * swatch_height() + MARGIN
    page = Sheet(options.width, height)
    page.heading(
        f"Skin of template {template.name} {template.version}",
        f"{len(template.regions)} regions, {len(template.landmarks)} landmarks",
    )
    body = _body(template, palette)
    width = options.width // len(VIEWS)
    for column, (_, yaw) in enumerate(VIEWS):
        camera = _camera(template, yaw)
        corner = (column * width, HEADER)
        page.panel(corner, render([body], camera, width, options.height))
        _mark(page, template, camera, corner, width, options)
    page.swatches((MARGIN, HEADER + options.height + MARGIN), legend, across)
    page.save(path)


def _body(template: Template, palette: dict[str, Colour]) -> DrawnBody:
    head = DrawnHead(template.skin)
    lit = head.lit(template.skin.vertices)
    colour = head.body(lit).colour.copy()
    for name, vertices in template.regions.items():
        colour[vertices] = linear(np.array(palette[name]))
    return DrawnBody(lit, colour, gloss=0.0)


def _mark(
    page: Sheet,
    template: Template,
    camera: Camera,
    corner: tuple[int, int],
    width: int,
    options: SkinSheetOptions,
) -> None:
    """Put a dot and the number of each landmark that faces the camera."""
    dot = options.dot
    if not template.landmarks:
        return
    vertices = np.array(list(template.landmarks.values()))
    points = template.skin.vertices[vertices]
    flesh = Surface(template.skin.vertices, template.skin.faces[template.flesh_faces])
    facing = vertex_normals(flesh)[vertices] @ camera.axes[2]
    for number, (x, y, _) in enumerate(camera.project(points, width, options.height), start=1):
        if facing[number - 1] > options.facing:
            place = (corner[0] + round(x), corner[1] + round(y))
            box = [place[0] - dot, place[1] - dot, place[0] + dot, place[1] + dot]
            page.draw.ellipse(box, fill=INK)
            page.text((place[0] + dot + 2, place[1]), str(number), 13, anchor="lm")


def _number_landmarks(template: Template) -> dict[str, Colour]:
    ink: Colour = (INK[0] / 255, INK[1] / 255, INK[2] / 255)
    return {f"{number}  {name}": ink for number, name in enumerate(template.landmarks, start=1)}


def _palette(names: list[str]) -> dict[str, Colour]:
    """Return pale sRGB colours, hues by the golden ratio."""
    return {
        name: colorsys.hls_to_rgb((0.04 + number * 0.381966) % 1.0, 0.72, 0.55)
        for number, name in enumerate(names)
    }


def _camera(template: Template, yaw: float) -> Camera:
    face: Floats = template.skin.vertices[template.face_vertices]
    low, high = face.min(axis=0), face.max(axis=0)
    return Camera((low + high) / 2, span=1.3 * float(high[1] - low[1]), yaw=yaw)
