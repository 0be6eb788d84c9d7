"""Images of coloured surfaces: soft light, a little gloss, several layers over one another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from solver.surface import Floats, Ints, Surface, unit_rows, vertex_normals

# Soft studio light, from a few dozen directions: one small depth map for each tells which vertices
# it reaches, so that hollows darken and noses cast soft shadows without tracing a ray.

SKY = np.array([0.30, 0.31, 0.34])  # linear RGB, as all light here
GROUND = np.array([0.15, 0.12, 0.11])
LAMPS = (  # direction, colour, sharpness
    (np.array([-0.60, 0.60, 0.75]), np.array([3.60, 3.42, 3.20]), 7.0),
    (np.array([0.85, 0.10, 0.60]), np.array([0.62, 0.70, 0.84]), 4.0),
    (np.array([0.60, 0.45, -0.90]), np.array([1.60, 1.65, 1.75]), 7.0),
)


@dataclass(frozen=True)
class Shadows:
    """Fineness of the light: its directions and their depth maps."""

    directions: int = 72
    map_pixels: int = 256
    lift_mm: float = 1.5  # off the surface, so that a triangle does not shade its own corners
    bias_pixels: float = 1.5  # in depth, for the same reason
    exposure: float = 3.6


SHADOWS = Shadows()


def irradiance(surface: Surface, normals: Floats, shadows: Shadows = SHADOWS) -> Floats:
    """Return the light (n, 3), linear RGB, that falls on each vertex; a bright one is about 1."""
    directions = sphere(shadows.directions)
    colours = _studio(directions) * shadows.exposure / shadows.directions
    return gather(surface, normals, directions, colours, shadows)


def gather(
    surface: Surface, normals: Floats, directions: Floats, colours: Floats, shadows: Shadows
) -> Floats:
    """Return the sum (n, c) of ``colours`` (k, c) that fall on vertices from ``directions`` (k, 3).

    Each counts by the cosine to the vertex's normal, and not at all where the surface blocks it.
    """
    vertices = surface.vertices - (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices, axis=1).max()) + 2 * shadows.lift_mm
    limits = shadows.map_pixels, shadows.lift_mm, shadows.bias_pixels
    axes = _axes(directions)
    return np.asarray(_gather(vertices, surface.faces, normals, axes, colours, radius, *limits))


@njit(cache=True, error_model="numpy")
def _gather(
    vertices: Floats,
    faces: Ints,
    normals: Floats,
    axes: Floats,
    colours: Floats,
    radius: float,
    map_pixels: int,
    lift_mm: float,
    bias_pixels: float,
) -> Floats:
    """Return the light (n, c) along ``axes`` (k, 3, 3) on what lies within ``radius``."""
    # no matrix products: BLAS threads would take longer to wake than these take
    light = np.zeros((len(vertices), colours.shape[1]))
    places = np.empty((len(vertices), 3))
    scale = map_pixels / (2 * radius)
    for number in range(len(axes)):
        right, up, towards = axes[number]
        for vertex in range(len(vertices)):
            x, y, z = _corner(vertices, vertex)
            places[vertex, 0] = (x * right[0] + y * right[1] + z * right[2] + radius) * scale
            places[vertex, 1] = (x * up[0] + y * up[1] + z * up[2] + radius) * scale
            places[vertex, 2] = (x * towards[0] + y * towards[1] + z * towards[2]) * scale
        nearest = _depth_map(places, faces, map_pixels)
        for vertex in range(len(vertices)):
            x, y, z = _corner(normals, vertex)
            cosine = x * towards[0] + y * towards[1] + z * towards[2]
            if cosine <= 0.0:
                continue
            lift = lift_mm * scale
            column = int(places[vertex, 0] + lift * (x * right[0] + y * right[1] + z * right[2]))
            row = int(places[vertex, 1] + lift * (x * up[0] + y * up[1] + z * up[2]))
            if places[vertex, 2] + lift * cosine > nearest[row, column] - bias_pixels:
                for channel in range(colours.shape[1]):
                    light[vertex, channel] += cosine * colours[number, channel]
    return light


@njit(cache=True, error_model="numpy")
def _depth_map(places: Floats, faces: Ints, pixels: int) -> Floats:
    """Return the greatest third coordinate of triangles at ``places`` (n, 3), in pixels."""
    nearest = np.full((pixels, pixels), -np.inf)
    for face in range(len(faces)):
        ax, ay, az = _corner(places, faces[face, 0])
        bx, by, bz = _corner(places, faces[face, 1])
        cx, cy, cz = _corner(places, faces[face, 2])
        left = math.ceil(min(ax, bx, cx) - 0.5)
        right = math.floor(max(ax, bx, cx) - 0.5)
        top = math.ceil(min(ay, by, cy) - 0.5)
        bottom = math.floor(max(ay, by, cy) - 0.5)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0 or right < left or bottom < top:
            continue
        part = 1.0 / area
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x = column + 0.5
                y = row + 0.5
                a = ((bx - x) * (cy - y) - (cx - x) * (by - y)) * part
                b = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) * part
                if a >= 0.0 and b >= 0.0 and a + b <= 1.0:
                    depth = a * az + b * bz + (1.0 - a - b) * cz
                    nearest[row, column] = max(nearest[row, column], depth)
    return nearest


@njit(cache=True, inline="always")
def _corner(points: Floats, number: int) -> tuple[float, float, float]:
    # unpacked at once, a row would be made an array first
    return points[number, 0], points[number, 1], points[number, 2]


def _studio(directions: Floats) -> Floats:
    """Return the light (k, 3) that comes from each direction (k, 3)."""
    up = (directions[:, 1:2] + 1) / 2
    light = up * SKY + (1 - up) * GROUND
    for towards, colour, sharpness in LAMPS:
        cosine = directions @ (towards / np.linalg.norm(towards))
        light = light + np.exp(sharpness * (cosine - 1))[:, None] * colour
    return np.asarray(light)


def sphere(count: int) -> Floats:
    """Return unit vectors (count, 3) spread evenly (Fibonacci lattice)."""
    number = np.arange(count) + 0.5
    y = 1 - 2 * number / count
    turn = np.pi * (3 - np.sqrt(5)) * number
    ring = np.sqrt(1 - y * y)
    return np.column_stack([ring * np.cos(turn), y, ring * np.sin(turn)])


def _axes(directions: Floats) -> Floats:
    """Return unit vectors right, up and towards (k, 3, 3) of maps that look along directions."""
    helper = np.where(np.abs(directions[:, :1]) < 0.7, np.eye(3)[0], np.eye(3)[1])
    right = unit_rows(np.cross(helper, directions))
    return np.stack([right, np.cross(directions, right), directions], axis=1)


# A small z-buffer: the triangle that is seen in each pixel, without a window system or a GPU.

Pixels = NDArray[np.float32]


LAMP = np.array([0.35, 0.45, 0.82])  # where it is: right of the camera, above, behind it


@dataclass(frozen=True)
class Camera:
    """A camera that looks at ``centre`` (3,) from ``distance`` mm.

    ``yaw`` 0 looks at the face from the front, positive from the subject's left; ``pitch`` is
    positive from above (rad). ``span`` is the height in mm that the image shows at the centre.
    """

    centre: Floats
    span: float
    yaw: float = 0.0
    pitch: float = 0.0
    distance: float = 1100.0

    @property
    def axes(self) -> Floats:
        """Return rows right, up and backward (3, 3), unit vectors."""
        sy = np.sin(self.yaw)
        cy = np.cos(self.yaw)
        sp = np.sin(self.pitch)
        cp = np.cos(self.pitch)
        return np.array([[cy, 0.0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]])

    def brightness(self, normals: Floats) -> Floats:
        """Return how much light (n,), 0 to 1, falls on unit normals from a lamp by the camera."""
        return np.asarray(np.abs(normals @ (self.axes.T @ LAMP)))

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return pixel column, pixel row and depth in mm of points (n, 3)."""
        seen = np.einsum("ij,kj->ik", points - self.centre, self.axes)
        depth = self.distance - seen[:, 2]
        scale = height / self.span * self.distance / depth
        return np.column_stack(
            [width / 2 + seen[:, 0] * scale, height / 2 - seen[:, 1] * scale, depth]
        )


@dataclass(frozen=True)
class Visible:
    """The triangles a camera sees: ``triangle`` (h, w), -1 for none, and ``weights`` (h, w, 3)."""

    triangle: NDArray[np.int32]
    weights: Pixels
    faces: Ints

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Return (h, w), true where there is a triangle."""
        return self.triangle >= 0

    @property
    def places(self) -> tuple[Ints, Floats]:
        """Return triangle (k,) and shares (k, 3) of its corners at the pixels of the mask."""
        mask = self.mask
        return self.triangle[mask].astype(np.int64), self.weights[mask].astype(np.float64)

    def interpolate(self, values: Floats) -> Pixels:
        """Return vertex values (n, k) at the pixels where there is a triangle, (pixels, k)."""
        mask = self.mask
        corners = self.faces[self.triangle[mask]]
        return _blend(values.astype(np.float32), corners, self.weights[mask])


def look(camera: Camera, surface: Surface, width: int, height: int) -> Visible:
    """Return what ``camera`` sees of ``surface`` in an image of width x height pixels."""
    return rasterise(camera.project(surface.vertices, width, height), surface.faces, width, height)


def rasterise(points: Floats, faces: Ints, width: int, height: int) -> Visible:
    """Return what is seen of triangles whose vertices (n, 3) are column, row and depth in mm."""
    triangle, weights = _rasterise(points, faces, width, height)
    return Visible(triangle, weights, faces)


@njit(cache=True, error_model="numpy")
def _rasterise(
    points: Floats, faces: Ints, width: int, height: int
) -> tuple[NDArray[np.int32], Pixels]:
    """Return the nearest triangle and its perspective-correct weights, per pixel."""
    triangle = np.full((height, width), -1, np.int32)
    weights = np.zeros((height, width, 3), np.float32)
    nearness = np.zeros((height, width), np.float32)
    for face in range(len(faces)):
        ax, ay, az = _corner(points, faces[face, 0])
        bx, by, bz = _corner(points, faces[face, 1])
        cx, cy, cz = _corner(points, faces[face, 2])
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0 or min(az, bz, cz) <= 0.0:
            continue
        left = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
        right = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        top = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
        bottom = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x = column + 0.5
                y = row + 0.5
                a = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                b = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                near = a / az + b / bz + c / cz
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    triangle[row, column] = face
                    weights[row, column, 0] = a / az / near
                    weights[row, column, 1] = b / bz / near
                    weights[row, column, 2] = c / cz / near
    return triangle, weights


@njit(cache=True)
def _blend(values: Pixels, corners: Ints, weights: Pixels) -> Pixels:
    blended = np.empty((len(corners), values.shape[1]), np.float32)
    for pixel in range(len(corners)):
        a, b, c = corners[pixel]
        for column in range(values.shape[1]):
            blended[pixel, column] = (
                weights[pixel, 0] * values[a, column]
                + weights[pixel, 1] * values[b, column]
                + weights[pixel, 2] * values[c, column]
            )
    return blended


# Pictures: surfaces with colour, gloss and opacity, in light.

SUPERSAMPLING = 2  # pixels a side that make one of the image
SUBPIXELS = tuple(product(range(SUPERSAMPLING), repeat=2))
BACKGROUND = np.array([0.975, 0.975, 0.98], np.float32)  # sRGB
GAMMA = 2.2  # of sRGB, nearly
EDGE = 0.55  # how much darker a drawn edge is
SHOULDER = 0.3  # of the tone curve, at which bright spots roll off instead of burning out
FADE = 0.85, 0.96  # where a bust begins to fade and is gone, parts of the height from above


class Lit:
    """A surface with its normals and light, which all cameras and colourings share.

    ``light`` (n, 3) may be that of the surface in another pose, for films: making it takes longer
    than all the rest of a picture.
    """

    def __init__(self, surface: Surface, light: Floats | None = None) -> None:
        self.surface = surface
        self.normals = vertex_normals(surface)
        self.light = irradiance(surface, self.normals) if light is None else light


# Takes numbers of triangles (k,) and shares (k, 3) of their corners, and returns colours (k, 3),
# sRGB in [0, 1], and which places (k,) have one.
ColoursAt = Callable[[Ints, Floats], tuple[Floats, NDArray[np.bool_]]]


@dataclass(frozen=True)
class DrawnBody:
    """A lit surface with a linear colour (n, 3) per vertex, and how it is drawn.

    ``gloss`` is the strength of the highlight. An ``opacity`` under 1 lets what is behind shine
    through where the surface faces the camera, while its outline stays. ``edges`` draws triangles'
    edges. ``faces`` (f, 3) are those that are drawn, all by default. ``cover`` (n,) is how much of
    each vertex is there, 0 where a surface fades out before it ends. ``image`` colours what it
    knows of the drawn triangles in place of their vertices' colours.
    """

    lit: Lit
    colour: Floats
    gloss: float = 0.12
    opacity: float = 1.0
    edges: bool = False
    faces: Ints | None = None
    cover: Floats | None = None
    image: ColoursAt | None = None

    @property
    def drawn(self) -> Surface:
        """Return the surface with only the faces that are drawn."""
        surface = self.lit.surface
        return surface if self.faces is None else Surface(surface.vertices, self.faces)


def render(bodies: list[DrawnBody], camera: Camera, width: int, height: int) -> Pixels:
    """Return an sRGB image (height, width, 3) in [0, 1]; later bodies are drawn over earlier ones.

    Opaque bodies should be one body, as only within a body what is nearer hides what is behind.
    """
    wide = width * SUPERSAMPLING
    high = height * SUPERSAMPLING
    image = np.full((high, wide, 3), BACKGROUND**GAMMA)
    for body in bodies:
        _draw(image, body, look(camera, body.drawn, wide, high), camera)
    parts = [image[row::SUPERSAMPLING, column::SUPERSAMPLING] for row, column in SUBPIXELS]
    mean = sum(parts[1:], parts[0]) / len(parts)
    return np.asarray(np.clip(mean, 0, 1) ** (1 / GAMMA), np.float32)


def render_bust(bodies: list[DrawnBody], camera: Camera, size: tuple[int, int]) -> Pixels:
    """Return :func:`render` of ``size`` (width, height), run out below where scans are cut off."""
    image = render(bodies, camera, *size)
    rows = np.linspace(0, 1, len(image), dtype=np.float32)
    start, end = FADE
    part = np.clip((rows - start) / (end - start), 0, 1)[:, None, None]
    part = part * part * (3 - 2 * part)
    return np.asarray(image * (1 - part) + BACKGROUND * part, np.float32)


def _draw(image: Pixels, body: DrawnBody, seen: Visible, camera: Camera) -> None:
    """Draw what is seen of a body over an ``image`` (h, w, 3) in linear colours."""
    lit = body.lit
    cover = np.ones(len(lit.normals)) if body.cover is None else body.cover
    columns = [body.colour, lit.light, lit.normals, lit.surface.vertices, cover[:, None]]
    edges = np.zeros((0, 0), np.float32)
    if body.edges:
        edges = np.zeros(seen.triangle.shape, np.float32)
        edges[seen.mask] = _edge_strength(seen)[:, 0]
    eye = camera.centre + camera.distance * camera.axes[2]
    key = LAMPS[0][0] / np.linalg.norm(LAMPS[0][0])
    values = np.hstack(columns).astype(np.float32)
    pixels = seen.triangle, seen.weights, seen.faces
    own = np.zeros((0, 0, 3), np.float32)
    if body.image is not None:
        own = _image_colours(body.image, seen)
    _shade(image, *pixels, values, own, eye, key, body.gloss, body.opacity, edges)


def _image_colours(image: ColoursAt, seen: Visible) -> Pixels:
    """Return linear colours (h, w, 3) of pixels by an image, not-a-number where it has none."""
    mask = seen.mask
    srgb, known = image(*seen.places)
    colours = np.full((*mask.shape, 3), np.nan, np.float32)
    colours[mask] = np.where(known[:, None], srgb**GAMMA, np.nan)
    return colours


@njit(cache=True, error_model="numpy")
def _shade(
    image: Pixels,
    triangle: NDArray[np.int32],
    weights: Pixels,
    faces: Ints,
    values: Pixels,
    own: Pixels,
    eye: Floats,
    key: Floats,
    gloss: float,
    opacity: float,
    edges: Pixels,
) -> None:
    """Draw over ``image`` what ``values`` (n, 13) of vertices make of every pixel.

    They are colour, light, normal, place and cover. ``edges`` (h, w) and pixels' ``own`` colours
    (h, w, 3) are empty without any.
    """
    at = np.empty(values.shape[1])
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            face = triangle[row, column]
            if face < 0:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            u, v, w = weights[row, column, 0], weights[row, column, 1], weights[row, column, 2]
            for k in range(len(at)):
                at[k] = u * values[a, k] + v * values[b, k] + w * values[c, k]
            nx, ny, nz = at[6], at[7], at[8]
            size = 1.0 / (math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-6)
            vx, vy, vz = eye[0] - at[9], eye[1] - at[10], eye[2] - at[11]
            away = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
            facing = abs(nx * vx + ny * vy + nz * vz) * size * away
            hx, hy, hz = vx * away + key[0], vy * away + key[1], vz * away + key[2]
            half = size / math.sqrt(hx * hx + hy * hy + hz * hz)
            shine = gloss * min(max((nx * hx + ny * hy + nz * hz) * half, 0.0), 1.0) ** 28
            there = at[12]
            if opacity < 1.0:
                there *= opacity + (1.0 - opacity) * max(1.0 - facing, 0.0) ** 2.5
            dim = 1.0 - EDGE * edges[row, column] if len(edges) else 1.0
            for k in range(3):
                base = at[k]
                if len(own) and not math.isnan(own[row, column, k]):
                    base = own[row, column, k]
                colour = (base + shine) * at[3 + k]
                colour *= dim * (1.0 + SHOULDER) / (1.0 + SHOULDER * colour)
                image[row, column, k] += there * (colour - image[row, column, k])


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
