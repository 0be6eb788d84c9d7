"""Soft studio light: what reaches each vertex from a few dozen directions, with shadows.

One small depth map per direction tells which vertices it reaches, so hollows darken and noses cast
soft shadows without tracing a ray.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from solver.surface import Floats, Ints, Surface

DIRECTIONS = 72
MAP_PIXELS = 256
LIFT_MM = 1.5  # off the surface, so that a triangle does not shade its own corners
BIAS_PIXELS = 1.5
EXPOSURE = 3.6
SKY = np.array([0.30, 0.31, 0.34])
GROUND = np.array([0.15, 0.12, 0.11])
LAMPS = (  # direction, colour, sharpness
    (np.array([-0.60, 0.60, 0.75]), np.array([3.60, 3.42, 3.20]), 7.0),
    (np.array([0.85, 0.10, 0.60]), np.array([0.62, 0.70, 0.84]), 4.0),
    (np.array([0.60, 0.45, -0.90]), np.array([1.60, 1.65, 1.75]), 7.0),
)


def irradiance(surface: Surface, normals: Floats) -> Floats:
    """Return the light (n, 3), linear RGB, that falls on each vertex; a bright one is about 1."""
    directions = _sphere(DIRECTIONS)
    vertices = surface.vertices - (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices, axis=1).max()) + 2 * LIFT_MM
    light = _gather(
        vertices,
        surface.faces,
        normals,
        np.stack([_axes(direction) for direction in directions]),
        _studio(directions) * EXPOSURE / DIRECTIONS,
        radius,
    )
    return np.asarray(light)


@njit(cache=True)
def _gather(
    vertices: Floats, faces: Ints, normals: Floats, axes: Floats, colours: Floats, radius: float
) -> Floats:
    """Return the light (n, 3) from all directions; ``axes`` (k, 3, 3) are those of their maps.

    ``vertices`` lie within ``radius`` of the origin. (No matrix products: BLAS threads would take
    longer to wake than these take.)
    """
    light = np.zeros((len(vertices), 3))
    places = np.empty((len(vertices), 3))
    scale = MAP_PIXELS / (2 * radius)
    for number in range(len(axes)):
        right, up, towards = axes[number]
        for vertex in range(len(vertices)):
            x, y, z = vertices[vertex]
            places[vertex, 0] = (x * right[0] + y * right[1] + z * right[2] + radius) * scale
            places[vertex, 1] = (x * up[0] + y * up[1] + z * up[2] + radius) * scale
            places[vertex, 2] = (x * towards[0] + y * towards[1] + z * towards[2]) * scale
        nearest = _depth_map(places, faces)
        for vertex in range(len(vertices)):
            x, y, z = normals[vertex]
            cosine = x * towards[0] + y * towards[1] + z * towards[2]
            if cosine <= 0.0:
                continue
            lift = LIFT_MM * scale
            column = int(places[vertex, 0] + lift * (x * right[0] + y * right[1] + z * right[2]))
            row = int(places[vertex, 1] + lift * (x * up[0] + y * up[1] + z * up[2]))
            if places[vertex, 2] + lift * cosine > nearest[row, column] - BIAS_PIXELS:
                light[vertex] += cosine * colours[number]
    return light


@njit(cache=True)
def _depth_map(places: Floats, faces: Ints) -> Floats:
    """Return the greatest third coordinate in each pixel of triangles seen along the third axis.

    ``places`` (n, 3) are in pixels of the map.
    """
    nearest = np.full((MAP_PIXELS, MAP_PIXELS), -np.inf)
    for face in range(len(faces)):
        ax, ay, az = places[faces[face, 0]]
        bx, by, bz = places[faces[face, 1]]
        cx, cy, cz = places[faces[face, 2]]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        left, right = int(np.ceil(min(ax, bx, cx) - 0.5)), int(np.floor(max(ax, bx, cx) - 0.5))
        top, bottom = int(np.ceil(min(ay, by, cy) - 0.5)), int(np.floor(max(ay, by, cy) - 0.5))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                a = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                b = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                if a >= 0.0 and b >= 0.0 and a + b <= 1.0:
                    depth = a * az + b * bz + (1.0 - a - b) * cz
                    nearest[row, column] = max(nearest[row, column], depth)
    return nearest


def _studio(directions: Floats) -> Floats:
    """Return the light (k, 3) that comes from each direction (k, 3)."""
    up = (directions[:, 1:2] + 1) / 2
    light = up * SKY + (1 - up) * GROUND
    for towards, colour, sharpness in LAMPS:
        cosine = directions @ (towards / np.linalg.norm(towards))
        light = light + np.exp(sharpness * (cosine - 1))[:, None] * colour
    return np.asarray(light)


def _sphere(count: int) -> Floats:
    """Return unit vectors (count, 3) spread evenly (Fibonacci lattice)."""
    number = np.arange(count) + 0.5
    y = 1 - 2 * number / count
    turn = np.pi * (3 - np.sqrt(5)) * number
    ring = np.sqrt(1 - y * y)
    return np.column_stack([ring * np.cos(turn), y, ring * np.sin(turn)])


def _axes(direction: Floats) -> Floats:
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    right = np.cross(helper, direction)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(direction, right), direction])
