"""A scan beside its registered skin, plain and with its normal map, in grazing light."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.documents import Figures
from solver.anatomy.template import Template
from solver.drawing.head import face_camera
from solver.drawing.render import Camera, look
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.meshio.colours import bilinear
from solver.meshio.raw import mend, read_raw
from solver.meshio.registered import read_registered
from solver.registration.detail import mesh_axes
from solver.registration.texels import Texels
from solver.registration.texture import texture_coordinates
from solver.registration.topology import topology
from solver.similarity import Similarity
from solver.surface import Floats, Surface, unit_rows, vertex_normals

LAMP = unit_rows(np.array([0.6, 0.7, 0.5]))  # by the head's axes
AMBIENT = 0.15
SIZE = 460, 545  # px of a view
YAW = np.radians(25.0)
TITLES = ("raw scan", "registered mesh", "with its normal map")
LAYOUT = SheetLayout(cell=SIZE, label=110, foot=20)


def draw_detail(path: Path, rows: Sequence[tuple[str, Path, Path]], template: Template) -> None:
    """Draw scans and what was registered of them: rows of a name, a scan and its folder."""
    pictures = [_row(scan, folder, template) for _, scan, folder in rows]
    columns = [
        Column(title, images)
        for title, images in zip(TITLES, zip(*pictures, strict=True), strict=True)
    ]
    names = [name for name, _, _ in rows]
    draw_sheet(path, "Detail", "lit from one side", names, columns, LAYOUT, scale_mm=None)


def read_placed(scan: Path, folder: Path, template: Template) -> tuple[Figures, Surface, Surface]:
    """Return registration.json, the registered skin, and the mended ``scan`` that lies on it."""
    told = json.loads((folder / "registration.json").read_text())
    motion = told["motion"]
    placed = Similarity(
        motion["scale"], np.array(motion["rotation"]), np.array(motion["translation"])
    )
    raw, _ = mend(read_raw(scan))
    rest = template.skin
    points = read_registered(folder / "registered.ply", rest.faces, len(rest.vertices)).vertices
    return told, rest.with_vertices(points), Surface(placed(raw.vertices), raw.faces)


def _row(scan: Path, folder: Path, template: Template) -> list[np.ndarray]:
    _, skin, surface = read_placed(scan, folder, template)
    camera = face_camera(skin.vertices, topology(template).face, YAW)
    image = Image.open(folder / "normals.png").convert("RGBA")
    return [
        _lit(camera, surface),
        _lit(camera, skin),
        _lit(camera, skin, template, np.asarray(image)),
    ]


def _lit(
    camera: Camera,
    surface: Surface,
    template: Template | None = None,
    normal_map: np.ndarray | None = None,
) -> np.ndarray:
    """Return the picture (h, w, 3) of a surface, with the normals of a map where it has places."""
    seen = look(camera, surface, *SIZE)
    normals: Floats = unit_rows(seen.interpolate(vertex_normals(surface)).astype(np.float64))
    if template is not None and normal_map is not None:
        coordinates = texture_coordinates(template)
        faces = seen.triangle[seen.mask].astype(np.int64)
        own = np.flatnonzero(np.isin(faces, coordinates.mapped))
        shares = seen.weights[seen.mask][own].astype(np.float64)
        none = np.zeros(len(own), np.int64)
        places = Texels(len(normal_map), none, none, faces[own], shares, surface)
        axes = mesh_axes(places, np.arange(len(own)), coordinates)
        at = places.blend(coordinates.pixels(1)[coordinates.corners[faces[own]]])
        local = unit_rows(2.0 * bilinear(normal_map, at)[:, :3] - 1.0)
        normals[own] = np.einsum("ni,nij->nj", local, axes)
    image = np.ones((*seen.mask.shape, 3), np.float32)
    light = AMBIENT + (0.9 - AMBIENT) * np.clip(normals @ LAMP, 0.0, 1.0)
    image[seen.mask] = light[:, None]
    return image
