"""A textured skin beside the raw scan that its colours are from, both drawn without light."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solver.drawing.head import face_camera
from solver.drawing.render import look
from solver.meshio.colours import ScanColours, bilinear
from solver.meshio.glb_colours import to_linear
from solver.registration.texture import Texture
from solver.surface import Floats, Ints, Surface, faces_within

YAWS = tuple(np.radians([0.0, 40.0, -40.0]))
SIZE = 640, 760  # px of a view
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


def compare(
    colours: ScanColours, placed: Floats, skin: Surface, face: Ints, texture: Texture
) -> tuple[dict[str, float], NDArray[np.uint8]]:
    """Return how far the textured ``skin`` is off the scan, and a picture of both.

    ``placed`` (n, 3) are the scan's vertices on the skin. ``delta_e_mean`` is the mean CIE 1976
    difference of colour over the pixels of three views in which the scan and the ``face`` (k,) of
    the skin are seen.
    """
    on_face = faces_within(skin.faces, face)
    image = np.dstack([texture.colours, np.full(texture.colours.shape[:2], 255, np.uint8)])
    rows = []
    apart = []
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
        apart.append(np.linalg.norm(to_lab(own) - to_lab(scan), axis=-1)[compared])
        rows.append(np.hstack([scan, shown]))
    every = np.concatenate(apart)
    figures = {"delta_e_mean": float(every.mean()), "delta_e_p95": float(np.percentile(every, 95))}
    return figures, np.round(255 * np.vstack(rows)).astype(np.uint8)


def _drawn(mask: NDArray[np.bool_], found: tuple[Floats, NDArray[np.bool_]]) -> Drawn:
    """Return colours at the pixels of a ``mask`` as an image, white elsewhere."""
    colour, known = found
    image = np.ones((*mask.shape, 3))
    image[mask] = np.where(known[:, None], colour, 1.0)
    where = np.zeros(mask.shape, bool)
    where[mask] = known
    return image, where


def save(pictures: Mapping[str, NDArray[np.uint8]], folder: Path) -> None:
    """Write pictures by their names as PNG."""
    for name, picture in pictures.items():
        Image.fromarray(picture).save(folder / f"{name}.png")
