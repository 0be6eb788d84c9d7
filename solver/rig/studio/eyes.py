"""The eyes of a light rig: an image of sclera, iris and pupil, and an eyeball's places in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from io import BytesIO

import numpy as np
from PIL import Image

from solver.drawing.head import COLOURS, IRIS_MM, PUPIL_MM
from solver.meshio.glb_colours import to_srgb
from solver.surface import Floats, nearest_sphere

EYE_COLOURS = "studio_eyes.png"  # beside a USD file, which names it


@dataclass(frozen=True)
class EyeImageOptions:
    """The image of an eye that looks at who sees it."""

    pixels: int = 512
    half_mm: float = 16.0  # from the pupil's middle to the image's edge, beyond an eyeball's radius
    rim_mm: float = 0.8  # in which the iris darkens towards the sclera
    blend_mm: float = 0.15  # of edges
    dark: float = 0.35  # share of its colour that an iris has at its rim


def eye_places(points: Floats, options: EyeImageOptions = EyeImageOptions()) -> Floats:
    """Return where (k, 2) the points (k, 3) of an eyeball at rest, mm, lie in the image.

    They count from the lower left corner; the back of the eyeball lies at the image's edge.
    """
    arm = points - nearest_sphere(points)[0]
    way = np.arctan2(arm[:, 1], arm[:, 0])
    edge = options.half_mm * np.column_stack([np.cos(way), np.sin(way)])
    seen = np.where(arm[:, 2:] < 0.0, edge, arm[:, :2])
    return np.asarray(0.5 + seen / (2.0 * options.half_mm))


@cache
def eye_image(options: EyeImageOptions = EyeImageOptions()) -> bytes:
    """Return a PNG of an eye that looks at who sees it."""
    side = (np.arange(options.pixels) + 0.5) / options.pixels * 2.0 - 1.0
    radius = options.half_mm * np.hypot(side[:, None], side[None, :])[..., None]

    def within(limit_mm: float) -> Floats:
        """Return the share (n, n, 1) of each pixel that lies within a circle."""
        return np.clip(0.5 + (limit_mm - radius) / options.blend_mm, 0.0, 1.0)

    rim = np.clip((radius - IRIS_MM + options.rim_mm) / options.rim_mm, 0.0, 1.0)
    iris = np.array(COLOURS["iris"]) * (1.0 - (1.0 - options.dark) * rim)
    colour = np.array(COLOURS["eyes"]) + within(IRIS_MM) * (iris - np.array(COLOURS["eyes"]))
    colour = colour + within(PUPIL_MM) * (np.array(COLOURS["pupil"]) - colour)
    content = BytesIO()
    pixels = np.round(255.0 * to_srgb(colour)).astype(np.uint8)
    Image.fromarray(pixels).save(content, "PNG", optimize=True)
    return content.getvalue()
