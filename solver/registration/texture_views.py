"""A textured skin beside the raw scan that its colours are from, both drawn without light."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from solver.drawing.head import face_camera
from solver.drawing.render import Pixels, look
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.meshio.colours import ScanColours
from solver.meshio.glb_colours import to_linear
from solver.meshio.texture_images import opaque
from solver.registration.skin_images import wear
from solver.registration.texture import Texture
from solver.surface import Floats, Ints, Surface, faces_within

UNKNOWN = 0.35  # grey of what is there and has no colour, as eyes have none
Known = NDArray[np.bool_]


@dataclass(frozen=True)
class ViewOptions:
    """From where a textured skin is compared with its scan, and how finely."""

    yaws: tuple[float, ...] = (0.0, 40.0, -40.0)  # degrees
    captions: tuple[str, ...] = ("front", "40 degrees to one side", "to the other")
    size: tuple[int, int] = (640, 760)  # px of a view, width and height


VIEWS = ViewOptions()

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


@dataclass(frozen=True, eq=False)
class TextureViews:
    """How far a textured skin is off its scan, and the views (h, w, 3), sRGB in [0, 1], of both.

    ``delta_e_mean`` of the figures is the mean CIE 1976 difference of colour over the pixels in
    which the scan and the face of the skin are seen, ``ssim`` the mean structural similarity of
    their lightness, ``seam_delta_e`` the mean difference across the face's seams. A figure that
    nothing could be compared for is left out.
    """

    figures: dict[str, float]
    scan: list[Pixels]
    skin: list[Pixels]

    def draw(self, path: Path, options: ViewOptions = VIEWS) -> None:
        """Write a picture of the scan's views over the skin's."""
        pairs = zip(options.captions, self.scan, self.skin, strict=True)
        columns = [Column(caption, [scan, skin]) for caption, scan, skin in pairs]
        told = self.figures
        detail = "no pixel shows both"
        if "ssim" in told:
            detail = (
                f"structural similarity {told['ssim']:.2f}    difference of colour "
                f"{told['delta_e_mean']:.1f} (CIE 1976), 95 % below {told['delta_e_p95']:.1f}"
            )
        layout = SheetLayout(cell=options.size, label=120, foot=24)
        rows = ("raw scan", "textured")
        draw_sheet(path, "Colours", detail, rows, columns, layout, scale_mm=None)


def compare_views(
    colours: ScanColours,
    placed: Floats,
    skin: Surface,
    face: Ints,
    texture: Texture,
    options: ViewOptions = VIEWS,
) -> TextureViews:
    """Draw a scan and its textured ``skin`` from the same sides, and compare them.

    ``placed`` (n, 3) are the scan's vertices on the skin; only the ``face`` (k,) of it counts.
    """
    finite = np.asarray(np.isfinite(placed).all(axis=1))
    numbers = np.flatnonzero(finite[colours.faces].all(axis=1))  # of triangles that can be drawn
    scan = Surface(np.where(finite[:, None], placed, 0.0), colours.faces[numbers])
    on_face = faces_within(skin.faces, face)
    worn = wear(skin, texture.coordinates, opaque(texture.colours))
    of_scan = []
    of_skin = []
    apart = []
    alike = []
    for yaw in np.radians(options.yaws):
        camera = face_camera(skin.vertices, face, yaw)
        raw = look(camera, scan, *options.size)
        drawn = look(camera, skin, *options.size)
        faces, shares = raw.places
        shown, known = _drawn(raw.mask, *colours.at(numbers[faces], shares))
        faces, shares = drawn.places
        colour, mapped = worn.at(faces, shares)
        of_scan.append(shown.astype(np.float32))
        of_skin.append(_drawn(drawn.mask, colour, mapped)[0].astype(np.float32))
        own, compared = _drawn(drawn.mask, colour, mapped & on_face[faces])
        compared &= known
        one, other = (to_lab(image[compared]) for image in (own, shown))
        apart.append(np.linalg.norm(one - other, axis=1))
        grey = [_spread(compared, each[:, 0] / 100.0) for each in (one, other)]
        alike.append(ssim(*grey)[compared])
    figures = _figures(np.concatenate(apart), np.concatenate(alike))
    across = seam_delta_e(worn, on_face)
    if across is not None:
        figures["seam_delta_e"] = across
    rounded = {name: round(value, 4) for name, value in figures.items()}
    return TextureViews(rounded, of_scan, of_skin)


def _figures(apart: Floats, alike: Floats) -> dict[str, float]:
    """Return what differences and likeness (k,) of pixels come to; nothing without any."""
    if not len(apart):
        return {}
    return {
        "ssim": float(alike.mean()),
        "delta_e_mean": float(apart.mean()),
        "delta_e_p95": float(np.percentile(apart, 95)),
    }


def seam_delta_e(worn: ScanColours, on_face: Known) -> float | None:
    """Return the mean CIE 1976 difference across a skin's seams; None: it has none.

    Seams count between triangles that are ``on_face`` (f,). Compared are the colours in the middle
    of an edge, by both of its triangles.
    """
    pairs = worn.seams(worn.faces)
    own = pairs[on_face[pairs % len(worn.faces)].all(axis=1)]
    if not len(own):
        return None
    one, other = (to_lab(worn.beside(sides)[0]) for sides in own.T)
    return float(np.linalg.norm(one - other, axis=1).mean())


def _spread(mask: Known, values: Floats) -> Floats:
    """Return an image (h, w) of ``values`` (k,) at the pixels of a ``mask``, 1 elsewhere."""
    image = np.ones(mask.shape)
    image[mask] = values
    return image


def _drawn(mask: Known, colour: Floats, known: Known) -> tuple[Floats, Known]:
    """Return colours at the pixels of a ``mask`` as an image, white around it, and where any is."""
    image = np.ones((*mask.shape, 3))
    image[mask] = np.where(known[:, None], colour, UNKNOWN)
    where = np.zeros(mask.shape, bool)
    where[mask] = known
    return image, where
