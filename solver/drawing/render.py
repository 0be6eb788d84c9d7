"""Images of coloured surfaces: soft light, a little gloss, several layers over one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.drawing.light import LAMPS, irradiance
from solver.drawing.raster import Camera, Pixels, Visible, look
from solver.normals import vertex_normals
from solver.surface import Floats, Ints, Surface

SUPERSAMPLING = 2
BACKGROUND = np.array([0.975, 0.975, 0.98], np.float32)  # sRGB
GAMMA = 2.2
SHOULDER = 0.3
FADE = (0.85, 0.96)  # of the height


class Lit:
    """A surface with its normals and light, which all cameras and colourings share.

    ``light`` (n, 3) may be that of the surface in another pose, for films: making it takes longer
    than all the rest of a picture.
    """

    def __init__(self, surface: Surface, light: Floats | None = None) -> None:
        self.surface = surface
        self.normals = vertex_normals(surface)
        self.light = irradiance(surface, self.normals) if light is None else light


@dataclass(frozen=True)
class Body:
    """A lit surface with a linear colour (n, 3) per vertex, and how it is drawn.

    ``gloss`` is the strength of the highlight. An ``opacity`` under 1 lets what is behind shine
    through where the surface faces the camera, while its outline stays. ``edges`` draws triangles'
    edges. ``faces`` (f, 3) are those that are drawn, all by default.
    """

    lit: Lit
    colour: Floats
    gloss: float = 0.12
    opacity: float = 1.0
    edges: bool = False
    faces: Ints | None = None

    @property
    def drawn(self) -> Surface:
        """Return the surface with only the faces that are drawn."""
        surface = self.lit.surface
        return surface if self.faces is None else Surface(surface.vertices, self.faces)


def render(bodies: list[Body], camera: Camera, width: int, height: int) -> Pixels:
    """Return an sRGB image (height, width, 3) in [0, 1]; later bodies are drawn over earlier ones.

    Opaque bodies should be one body, as only within a body what is nearer hides what is behind.
    """
    wide, high = width * SUPERSAMPLING, height * SUPERSAMPLING
    image = np.broadcast_to(BACKGROUND**GAMMA, (high, wide, 3)).copy()
    for body in bodies:
        seen = look(camera, body.drawn, wide, high)
        colour, opacity = _shade(body, seen, camera)
        mask = seen.mask
        image[mask] += opacity * (colour - image[mask])
    image = image.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(image, 0, 1) ** (1 / GAMMA), np.float32)


def faded(image: Pixels) -> Pixels:
    """Return a bust whose lower end, where scans are cut off, runs out into the background."""
    rows = np.linspace(0, 1, len(image), dtype=np.float32)
    share = np.clip((rows - FADE[0]) / (FADE[1] - FADE[0]), 0, 1)[:, None, None]
    share = share * share * (3 - 2 * share)
    return np.asarray(image * (1 - share) + BACKGROUND * share, np.float32)


def _shade(body: Body, seen: Visible, camera: Camera) -> tuple[Pixels, Pixels]:
    """Return linear colour (pixels, 3) and opacity (pixels, 1) of what is seen of a body."""
    columns = [body.colour, body.lit.light, body.lit.normals, body.lit.surface.vertices]
    albedo, light, normal, place = np.split(seen.interpolate(np.hstack(columns)), 4, axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-6
    view = (camera.centre + camera.distance * camera.axes[2]).astype(np.float32) - place
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    facing = np.abs(np.einsum("ij,ij->i", normal, view))[:, None]
    colour = albedo * light
    key = LAMPS[0][0] / np.linalg.norm(LAMPS[0][0])
    half = view + key.astype(np.float32)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.clip(np.einsum("ij,ij->i", normal, half), 0, 1)[:, None] ** 28
    colour += body.gloss * shine * light
    colour *= (1 + SHOULDER) / (
        1 + SHOULDER * colour
    )  # bright spots roll off instead of burning out
    if body.edges:
        colour *= 1 - 0.55 * _edge_strength(seen)
    opacity = np.ones_like(facing)
    if body.opacity < 1:
        opacity = body.opacity + (1 - body.opacity) * (1 - facing) ** 2.5
    return colour, opacity


def _edge_strength(seen: Visible) -> Pixels:
    """Return 1 on the edges of triangles and 0 inside, (pixels, 1)."""
    weights = seen.weights
    steps = np.zeros_like(weights)
    steps[:, :-1] = np.abs(np.diff(weights, axis=1))
    steps[:-1] = np.maximum(steps[:-1], np.abs(np.diff(weights, axis=0)))
    mask = seen.mask
    per_pixel = np.minimum(steps[mask], 0.34)
    pixels = (weights[mask] / np.maximum(per_pixel, 1e-6)).min(axis=1)
    return np.asarray(np.clip(1.6 - pixels, 0, 1)[:, None], np.float32)
