"""Figures and pictures of faces fitted to photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.drawing.head import SIDE, DrawnHead, face_camera
from solver.drawing.render import GAMMA, Pixels, rasterise, render_bust
from solver.drawing.sheet import HEADER, MARGIN, Sheet
from solver.model import SubjectModel
from solver.photo.camera import PinholeCamera
from solver.photo.expression import PhotoExpression, marks_of
from solver.photo.identity import IdentityFit
from solver.photo.light import Appearance
from solver.photo.oddities import LeftOut
from solver.photo.other_person import JudgedPhotos
from solver.photo.photo import Photo, square_around
from solver.photo.placed import Reprojection
from solver.photo.shading import blocked_light, shade_of
from solver.surface import Floats, Surface, vertex_normals

PANEL = 320  # pixels of a picture's side on a sheet
CLEAR = 2.0  # differences of colours are drawn so many times as strong
MARKS = {"given": (30, 110, 230), "fitted": (230, 60, 40)}  # sRGB bytes
MARK_PX = 2  # half of a mark's side


def photo_figures(
    photos: Sequence[Photo],
    result: PhotoExpression[Any],
    points: SkinPoints,
    placed: Mapping[str, Reprojection],
    others: JudgedPhotos,
) -> dict[str, Any]:
    """Return the figures of the fit of one moment as JSON values.

    ``placed`` has those of its photographs whose cameras were placed beside others, and
    ``others`` whether each is likelier of somebody else.
    """
    point = result.fit.point
    found = {
        photo.name: camera_figures(photo, camera, point.skin, points)
        for photo, camera in zip(photos, point.cameras, strict=True)
    }
    for name, each in placed.items():
        found[name]["reprojection"] = each.as_dict()
    for photo, skin in zip(photos, result.compared, strict=False):  # none without shading
        found[photo.name] |= skin.figures()
    for name in found:
        found[name] |= others.figures(name)
    return {
        "photos": found,
        "iterations": {
            "landmarks": result.landmarks.steps,
            "shading": result.steps - result.landmarks.steps,
        },
        "objective": round(result.fit.value, 3),
        "termination": str(result.fit.termination),
    }


def camera_figures(
    photo: Photo, camera: PinholeCamera, skin: Floats, points: SkinPoints
) -> dict[str, Any]:
    """Return the figures of a photograph's camera and landmarks as JSON values."""
    left = LeftOut.of(photo, points)
    known, given = marks_of(photo, points)
    away = np.linalg.norm(camera.project(known.at(skin))[:, :2] - given, axis=1)
    depth = float(np.median(camera.project(skin)[:, 2]))
    px_per_mm = float(camera.focal.mean()) / depth
    return {
        "size": list(photo.size),
        "camera": {
            "fx": round(float(camera.focal[0]), 2),
            "fy": round(float(camera.focal[1]), 2),
            "cx": round(float(camera.centre[0]), 2),
            "cy": round(float(camera.centre[1]), 2),
            "rotation": camera.rotation.round(6).tolist(),
            "translation": camera.translation.round(3).tolist(),
        },
        "camera_is_given": photo.camera is not None,
        "distance_mm": round(depth, 1),
        "landmarks": len(away),
        "left_out": {"curves": [*left.curves], "landmarks": [*left.landmarks]},
        "landmarks_px": round(float(away.mean()), 3),
        "landmarks_mm": round(float(away.mean()) / px_per_mm, 3),
    }


class SeenFace(NamedTuple):
    """A photograph, and the face that was fitted to it."""

    photo: Photo
    camera: PinholeCamera
    skin: Floats  # (V, 3)
    look: Appearance | None


def seen_faces(photos: Sequence[Photo], result: PhotoExpression[Any]) -> list[SeenFace]:
    """Return the fit of one moment by its photographs."""
    point = result.fit.point
    looks = result.appearances or (None,) * len(photos)
    return [
        SeenFace(photo, camera, point.skin, look)
        for photo, camera, look in zip(photos, point.cameras, looks, strict=True)
    ]


def photo_picture(
    model: SubjectModel, fitted: Sequence[SeenFace], points: SkinPoints, path: Path
) -> None:
    """Draw a row for each photograph: plate, landmarks, shaded skin, difference, and from aside."""
    head = DrawnHead(model.skin)
    drawn = []
    for photo, camera, skin, look in fitted:
        plate, corner = _part(photo, camera.project(skin[model.face])[:, :2])
        inside = replace(camera, centre=camera.centre - corner)
        shaded = _draw_skin(plate, inside, model.skin.with_vertices(skin), model, look)
        difference = np.clip(0.5 + CLEAR * (shaded - plate), 0.0, 1.0)
        known, given = marks_of(photo, points)
        marked = _draw_landmarks(plate, given - corner, inside.project(known.at(skin))[:, :2])
        aside = head.body(head.lit(skin))
        bust = face_camera(skin, model.face, SIDE)
        panels = [_panel(each) for each in (plate, marked, shaded, difference)]
        panels.append(render_bust([aside], bust, (PANEL, PANEL)))
        drawn.append((photo.name, panels))
    detail = "plate; landmarks given (blue) and fitted (red); skin; difference; aside"
    _draw_rows("Photographs", detail, drawn, path)


def identity_picture(
    template: Template, photos: Sequence[Photo], found: IdentityFit, points: SkinPoints, path: Path
) -> None:
    """Draw a row for each photograph: plate, landmarks, the face in it, at rest, and aside."""
    head = DrawnHead(template.skin)
    drawn = []
    for row, photo in enumerate(photos):
        camera = found.cameras[row]
        skin = found.skins[row]
        plate, corner = _part(photo, camera.project(skin[template.face_vertices])[:, :2])
        known, given = marks_of(photo, points)
        fitted = camera.project(known.at(skin))[:, :2]
        marked = _draw_landmarks(plate, given - corner, fitted - corner)
        panels = [_panel(each) for each in (plate, marked)]
        for shown, view in ((skin, 0.0), (found.neutral, 0.0), (found.neutral, SIDE)):
            bust = face_camera(shown, template.face_vertices, view)
            panels.append(render_bust([head.body(head.lit(shown))], bust, (PANEL, PANEL)))
        drawn.append((photo.name, panels))
    detail = "plate; landmarks given (blue) and fitted (red); the person in it; at rest; aside"
    _draw_rows("A person from photographs", detail, drawn, path)


def _draw_rows(
    title: str, detail: str, rows: Sequence[tuple[str, Sequence[Pixels]]], path: Path
) -> None:
    """Draw rows of five panels, each row under its name."""
    page = Sheet(2 * MARGIN + 5 * PANEL, HEADER + max(len(rows), 1) * (PANEL + 30) + MARGIN)
    page.heading(title, detail)
    for row, (name, panels) in enumerate(rows):
        top = HEADER + row * (PANEL + 30)
        page.text((MARGIN, top), name, 17)
        for column, pixels in enumerate(panels):
            page.panel((MARGIN + column * PANEL, top + 26), pixels)
    page.save(path)


def _part(photo: Photo, places: Floats) -> tuple[Pixels, Floats]:
    """Return the part of a photograph around places (n, 2), and its upper left corner (2,)."""
    left, top, right, bottom = square_around(places, photo)
    return photo.pixels[top:bottom, left:right], np.array([left, top])


def _draw_skin(
    plate: Pixels,
    camera: PinholeCamera,
    skin: Surface,
    model: SubjectModel,
    look: Appearance | None,
) -> Pixels:
    """Return a plate with the face's skin over it, in the light that was found."""
    if look is None:
        look = Appearance(np.full((9, 3), 0.05), np.ones_like(skin.vertices))
    shade = shade_of(vertex_normals(skin), blocked_light(skin), look.light)
    colours = np.clip(look.albedo * shade, 0.0, 1.0) ** (1.0 / GAMMA)
    within: NDArray[np.bool_] = np.asarray(np.isin(skin.faces, model.face).all(axis=1))
    height, width = plate.shape[:2]
    seen = rasterise(camera.project(skin.vertices), skin.faces, width, height)
    pixels = plate.copy()
    shown = seen.mask & within[np.maximum(seen.triangle, 0)]
    pixels[shown] = seen.interpolate(colours)[within[seen.triangle[seen.mask]]]
    return pixels


def _draw_landmarks(plate: Pixels, given: Floats, fitted: Floats) -> Pixels:
    """Return a plate with the landmarks as they are given and as they are fitted."""
    pixels = plate.copy()
    size = max(1, round(MARK_PX * max(np.ptp(given, axis=0).max() / PANEL, 0.5)))
    for name, places in (("given", given), ("fitted", fitted)):
        for column, row in np.nan_to_num(places).round().astype(int):
            high = slice(max(row - size, 0), max(row + size, 0))
            pixels[high, max(column - size, 0) : max(column + size, 0)] = (
                np.array(MARKS[name]) / 255
            )
    return pixels


def _panel(pixels: Pixels) -> Pixels:
    """Return a picture as large as fits on a panel."""
    part = Image.fromarray((np.clip(pixels, 0, 1) * 255).astype(np.uint8))
    scale = PANEL / max(part.size)
    part = part.resize((max(1, int(part.width * scale)), max(1, int(part.height * scale))))
    return np.asarray(part, np.float32) / np.float32(255)
