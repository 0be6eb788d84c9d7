"""A textured skin beside the raw scan that its colours are from, both drawn without light."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from benchmarks.documents import Figures
from solver.anatomy.template import Template
from solver.drawing.head import face_camera
from solver.drawing.render import look
from solver.jobs import run_job
from solver.meshio.colours import ScanColours, bilinear, read_colours
from solver.meshio.glb_colours import to_linear
from solver.meshio.raw import read_raw
from solver.meshio.registered import read_registered
from solver.registration.texture import Texture, texture_coordinates
from solver.registration.topology import topology
from solver.similarity import Similarity
from solver.surface import Floats, Ints, Surface, faces_within
from solver.templates.builtin.build import builtin_template

YAWS = tuple(np.radians([0.0, 40.0, -40.0]))
SIZE = 640, 760  # px of a view
IMAGES = ("texture.png", "texture_confidence.png")
Drawn = tuple[Floats, NDArray[np.bool_]]  # sRGB (h, w, 3) in [0, 1], and where there is colour

# CIELAB of linear sRGB with the white point D65 (IEC 61966-2-1, CIE 15).
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip
WHITE = XYZ.sum(axis=1)


def to_lab(srgb: Floats) -> Floats:
    """Return CIELAB values (..., 3) of sRGB in [0, 1]."""
    ratio = to_linear(srgb) @ XYZ.T / WHITE
    root = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


SIGMA = 1.5  # px of the window, and the constants: Wang, Bovik, Sheikh and Simoncelli 2004
STEADY = 0.01**2, 0.03**2


def ssim(one: Floats, other: Floats) -> Floats:
    """Return the structural similarity (h, w) of grey images (h, w) in [0, 1]."""

    def mean(values: Floats) -> Floats:
        return np.asarray(gaussian_filter(values, SIGMA))

    a = mean(one)
    b = mean(other)
    spread = mean(one * one) - a * a + mean(other * other) - b * b
    common = mean(one * other) - a * b
    first = (2 * a * b + STEADY[0]) / (a * a + b * b + STEADY[0])
    return np.asarray(first * (2 * common + STEADY[1]) / (spread + STEADY[1]))


def compare(
    colours: ScanColours, placed: Floats, skin: Surface, face: Ints, texture: Texture
) -> tuple[dict[str, float], NDArray[np.uint8]]:
    """Return how far the textured ``skin`` is off the scan, and a picture of both.

    ``placed`` (n, 3) are the scan's vertices on the skin. ``delta_e_mean`` is the mean CIE 1976
    difference of colour over the pixels of three views in which the scan and the ``face`` (k,) of
    the skin are seen, ``ssim`` the mean structural similarity of their lightness.
    """
    on_face = faces_within(skin.faces, face)
    image = np.dstack([texture.colours, np.full(texture.colours.shape[:2], 255, np.uint8)])
    rows = []
    apart = []
    alike = []
    for yaw in YAWS:
        camera = face_camera(skin.vertices, face, yaw)
        raw = look(camera, Surface(placed, colours.faces), *SIZE)
        worn = look(camera, skin, *SIZE)
        at_scan = raw.triangle[raw.mask].astype(np.int64), raw.weights[raw.mask].astype(float)
        scan, known = _drawn(raw.mask, colours.at(*at_scan))
        faces = worn.triangle[worn.mask]
        corners = texture.coordinates.corners[faces]
        mapped = np.asarray((corners >= 0).all(axis=1))
        places = texture.coordinates.pixels(1)[np.maximum(corners, 0)]
        at = np.einsum("nc,ncd->nd", worn.weights[worn.mask], places)
        wears = bilinear(image, at)[:, :3]
        shown, _ = _drawn(worn.mask, (wears, mapped))
        own, compared = _drawn(worn.mask, (wears, mapped & on_face[faces]))
        compared &= known
        lab = to_lab(own), to_lab(scan)
        apart.append(np.linalg.norm(lab[0] - lab[1], axis=-1)[compared])
        grey = [np.where(compared, each[..., 0] / 100.0, 1.0) for each in lab]
        alike.append(ssim(*grey)[compared])
        rows.append(np.hstack([scan, shown]))
    every = np.concatenate(apart)
    figures = {
        "ssim": float(np.concatenate(alike).mean()),
        "delta_e_mean": float(every.mean()),
        "delta_e_p95": float(np.percentile(every, 95)),
    }
    return figures, np.round(255 * np.vstack(rows)).astype(np.uint8)


def seam_delta_e(skin: Surface, face: Ints, texture: Texture) -> float | None:
    """Return the mean CIE 1976 difference across the face's seams; None: it has none.

    Compared are the colours in the middle of an edge, by both of its triangles.
    """
    corners = texture.coordinates.corners
    own = np.flatnonzero(faces_within(skin.faces, face) & (corners >= 0).all(axis=1))
    sides = np.vstack([skin.faces[own][:, [k, (k + 1) % 3]] for k in range(3)])
    ends = np.vstack([corners[own][:, [k, (k + 1) % 3]] for k in range(3)])
    turned = sides[:, 0] > sides[:, 1]
    sides[turned] = sides[turned][:, ::-1]
    ends[turned] = ends[turned][:, ::-1]
    order = np.lexsort(sides.T)
    pairs = order[:-1][(sides[order[1:]] == sides[order[:-1]]).all(axis=1)]
    other = order[1:][(sides[order[1:]] == sides[order[:-1]]).all(axis=1)]
    cut = (ends[pairs] != ends[other]).all(axis=1)
    if not cut.any():
        return None
    image = np.dstack([texture.colours, np.full(texture.colours.shape[:2], 255, np.uint8)])
    places = texture.coordinates.pixels(1)
    one, two = (
        to_lab(bilinear(image, places[ends[rows[cut]]].mean(axis=1))[:, :3])
        for rows in (pairs, other)
    )
    return float(np.linalg.norm(one - two, axis=1).mean())


def _drawn(mask: NDArray[np.bool_], found: tuple[Floats, NDArray[np.bool_]]) -> Drawn:
    """Return colours at the pixels of a ``mask`` as an image, white elsewhere."""
    colour, known = found
    image = np.ones((*mask.shape, 3))
    image[mask] = np.where(known[:, None], colour, 1.0)
    where = np.zeros(mask.shape, bool)
    where[mask] = known
    return image, where


def measure(scan: Path, template: Path | None, picture: Path | None) -> Figures:
    """Register a ``scan`` to a template, and return how close its textured skin is.

    ``picture`` is where scan and skin are drawn side by side.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        run_job("register_scan", out, scan=scan, template=template)
        told = json.loads((out / "registration.json").read_text())
        anatomy = builtin_template() if template is None else Template.load(template)
        skin = anatomy.skin
        points = read_registered(out / "registered.ply", skin.faces, len(skin.vertices)).vertices
        if "texture" not in told:
            return {"note": "the scan has no colours", "findings": told["findings"]}
        images = [np.array(Image.open(out / name)) for name in IMAGES]
    texture = Texture(images[0], images[1], texture_coordinates(anatomy), {})
    colours = read_colours(scan, read_raw(scan))
    assert colours is not None
    moved = told["motion"]
    turn = np.array(moved["rotation"])
    shift = np.array(moved["translation"])
    motion = Similarity(float(moved["scale"]), turn, shift)
    face = topology(anatomy).face
    found = compare(colours, motion(colours.vertices), skin.with_vertices(points), face, texture)
    if picture is not None:
        Image.fromarray(found[1]).save(picture)
    return {**told["texture"], **found[0], "seam_delta_e": seam_delta_e(skin, face, texture)}
