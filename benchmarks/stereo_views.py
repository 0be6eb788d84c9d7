"""A skin that wears one photograph of a stereo pair, drawn in the other one's camera.

The scan's texture coordinates are the projections into both photographs, which lie side by side in
one picture. What no skin could do better the scan itself shows: it is painted by the same
photograph, and drawn in the same camera.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.detail_views import read_placed
from benchmarks.documents import Figures
from benchmarks.photo_pair import fit_camera, read_texture
from solver.anatomy.template import Template
from solver.drawing.render import rasterise
from solver.jobs import run_job
from solver.meshio.colours import ScanColours, bilinear
from solver.meshio.paint import BARE, Paint
from solver.meshio.texture_images import opaque
from solver.photo.camera import PinholeCamera
from solver.registration.texture import TEXTURE, bake, texture_coordinates
from solver.registration.texture_views import ssim, to_lab
from solver.registration.topology import topology
from solver.similarity import Similarity
from solver.surface import Floats, Surface, area_normals, faces_within, unit_rows
from solver.templates.builtin.build import builtin_template

LEAST_COSINE = 0.3  # of a triangle to a camera that paints it
PX_PER_MM = 2.4  # of what is compared, as in the three views of the textured skin
UNMOVED = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class View:
    """A photograph (h, w, 3) in bytes, and the camera that took it, in the skin's frame."""

    pixels: NDArray[np.uint8]
    camera: PinholeCamera

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        height, width = self.pixels.shape[:2]
        return width, height

    def reduced(self, factor: float) -> View:
        """Return the view in an image that is ``factor`` times as large."""
        width, height = (round(factor * each) for each in self.size)
        image = Image.fromarray(self.pixels).resize((width, height), Image.Resampling.BOX)
        return View(np.asarray(image), self.camera.scaled(factor))

    def paint(self, scan: Surface) -> ScanColours:
        """Return the scan with its colours where this view shows it."""
        width, height = self.size
        points = self.camera.project(scan.vertices)
        seen = rasterise(points, scan.faces, width, height)
        shown = np.zeros(len(scan.faces), bool)
        shown[seen.triangle[seen.mask]] = True
        eye = -self.camera.rotation.T @ self.camera.translation
        normals = unit_rows(area_normals(scan.vertices, scan.faces))
        towards = unit_rows(eye - scan.vertices[scan.faces].mean(axis=1))
        shown &= np.einsum("nd,nd->n", normals, towards) > LEAST_COSINE
        image = opaque(self.pixels)
        places = (points[:, :2] / self.size)[scan.faces]
        return ScanColours(
            scan.vertices, scan.faces, Paint((image,), np.where(shown, 0, BARE), places)
        )


def read_views(scan: Path, placed: Similarity) -> tuple[View, View]:
    """Return both photographs of a textured OBJ whose points ``placed`` takes to a skin's frame."""
    picture = np.asarray(Image.open(scan.with_suffix(".jpg")).convert("RGB"))
    height, width = picture.shape[:2]
    half = width // 2
    points, places = read_texture(scan)
    pixels = places * (width, height)
    views = []
    for start in (0, half):
        inside = (pixels[:, 0] >= start) & (pixels[:, 0] < start + half)
        camera, _ = fit_camera(placed(points[inside]), pixels[inside] - [start, 0.0])
        views.append(View(picture[:, start : start + half], camera))
    return views[0], views[1]


def measure_stereo(scan: Path, template: Path | None, picture: Path) -> Figures:
    """Register a stereo rig's ``scan``, and return how its skin looks from where it was not seen.

    ``ssim`` is the mean structural similarity of the lightness where the skin's colours are seen in
    the other photograph, ``scan_ssim`` that of the scan itself, both the mean of the two ways
    round. ``picture`` is where photographs and skins are drawn.
    """
    anatomy = builtin_template() if template is None else Template.load(template)
    with tempfile.TemporaryDirectory() as folder:
        run_job("register_scan", folder, scan=scan, template=template)
        told, skin, surface = read_placed(scan, Path(folder), anatomy)
    moved = told["motion"]
    turn = np.array(moved["rotation"])
    placed = Similarity(float(moved["scale"]), turn, np.array(moved["translation"]))
    views = read_views(scan, placed)
    known = topology(anatomy)
    coordinates = texture_coordinates(anatomy)
    on_face = faces_within(skin.faces, known.face)
    found = []
    rows = []
    for one, other in (views, views[::-1]):
        colours = one.paint(surface)
        texture = bake(colours, UNMOVED, skin, known, coordinates)
        middle = skin.vertices[known.face].mean(axis=0, keepdims=True)
        px_per_mm = other.camera.focal[1] / other.camera.project(middle)[0, 2]
        view = other.reduced(PX_PER_MM / px_per_mm)
        width, height = view.size
        seen = rasterise(view.camera.project(skin.vertices), skin.faces, width, height)
        faces = seen.triangle[seen.mask]
        corners = coordinates.corners[faces]
        places = coordinates.pixels(1)[np.maximum(corners, 0)]
        at = np.einsum("nc,ncd->nd", seen.weights[seen.mask].astype(float), places)
        worn = bilinear(np.dstack([texture.colours, texture.confidence]), at)
        sure = (corners >= 0).all(axis=1) & on_face[faces] & (worn[:, 3] > TEXTURE.least_seen)
        where = np.zeros((height, width), bool)
        where[seen.mask] = sure
        drawn = view.pixels / 255.0
        drawn[seen.mask] = np.where(on_face[faces][:, None], worn[:, :3], drawn[seen.mask])
        scanned, is_scanned = _drawn(one.reduced(PX_PER_MM / px_per_mm), surface, view)
        both = where & is_scanned
        photo = view.pixels / 255.0
        found.append(
            {
                "ssim": _alike(drawn, photo, where),
                "scan_ssim": _alike(scanned, photo, both),
                "skin_ssim": _alike(drawn, photo, both),
                "seen_share": float(where.sum() / on_face[faces].sum()),
            }
        )
        rows.append(np.hstack([photo, drawn]))
    Image.fromarray(np.round(255 * np.hstack(rows)).astype(np.uint8)).save(picture)
    return {name: float(np.mean([each[name] for each in found])) for name in found[0]}


def _drawn(one: View, scan: Surface, other: View) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the scan with the colours of one view in the ``other``, and where it has some."""
    width, height = other.size
    seen = rasterise(other.camera.project(scan.vertices), scan.faces, width, height)
    colour, known = one.paint(scan).at(
        seen.triangle[seen.mask].astype(np.int64), seen.weights[seen.mask].astype(float)
    )
    image = np.ones((height, width, 3))
    image[seen.mask] = colour
    where = np.zeros((height, width), bool)
    where[seen.mask] = known
    return image, where


def _alike(one: Floats, other: Floats, where: NDArray[np.bool_]) -> float:
    """Return the mean structural similarity of the lightness of two pictures (h, w, 3)."""
    grey = [np.where(where, to_lab(each)[..., 0] / 100.0, 1.0) for each in (one, other)]
    return float(ssim(*grey)[where].mean())
