"""A headset for one person's face: a stiff frame around the eyes that follows the face."""

from __future__ import annotations

import igl
import numpy as np
from scipy.ndimage import gaussian_filter1d

from solver.model import SubjectModel
from solver.surface import Floats, Surface

HALF_WIDTH_MM = 62.0
HALF_HEIGHT_MM = 44.0
RIM_MM = 12.0
DEPTH_MM = 30.0
AROUND = 120
SQUARENESS = 4.0
"""Exponent of the superellipse that the frame is."""
TOUCH_MM = 6.0
"""The frame lies on the foremost skin within this distance across."""
SMOOTH = 3.0
MOST = 0.4
"""Part of the flesh over bone that the frame is pressed in at most."""


def headset(model: SubjectModel, apart_mm: float, pressed_mm: float) -> Surface:
    """Return a closed frame, ``apart_mm`` or more in front of the neutral face.

    Moved back by ``apart_mm + pressed_mm`` it lies ``pressed_mm`` deep where the flesh is thick
    enough, and less deep where bone is near: there it keeps away for as long.
    """
    skin = model.skin.vertices
    eyes = skin[np.concatenate([model.regions["left_eyeball"], model.regions["right_eyeball"]])]
    centre = eyes.mean(axis=0) - [0.0, 8.0, 0.0]
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    loops = [
        centre[:2] + _superellipse(angle, HALF_WIDTH_MM - inward, HALF_HEIGHT_MM - inward)
        for inward in (0.0, RIM_MM)
    ]
    back = [_rest_on(model, loop, pressed_mm) for loop in loops]
    # one height across the rim: the frame's own shape, not the face's every bump
    height = gaussian_filter1d(np.max(back, axis=0), SMOOTH, mode="wrap") + apart_mm
    front = np.full(AROUND, height.max() + DEPTH_MM)
    outer, inner = loops
    rings = [(outer, height), (outer, front), (inner, front), (inner, height)]
    vertices = np.vstack([np.column_stack([loop, z]) for loop, z in rings])
    here = np.arange(AROUND)
    there = np.roll(here, -1)
    faces = []
    for ring in range(len(rings)):
        a = ring * AROUND
        b = (ring + 1) % len(rings) * AROUND
        faces += [np.column_stack([a + here, a + there, b + there])]
        faces += [np.column_stack([a + here, b + there, b + here])]
    return Surface(vertices, np.vstack(faces).astype(np.int64))


def _superellipse(angle: Floats, width: float, height: float) -> Floats:
    across = np.cos(angle)
    up = np.sin(angle)
    size = (np.abs(across) ** SQUARENESS + np.abs(up) ** SQUARENESS) ** (-1.0 / SQUARENESS)
    return np.column_stack([width * size * across, height * size * up])


def _rest_on(model: SubjectModel, loop: Floats, pressed_mm: float) -> Floats:
    """Return the z (k,) at which a frame on the loop (k, 2) begins to be pressed in."""
    points = model.skin.vertices[model.face]
    squared, *_ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), model.bones["cranium"].vertices, model.bones["cranium"].faces
    )
    short = np.maximum(pressed_mm - MOST * np.sqrt(squared), 0.0)
    near = np.linalg.norm(points[:, None, :2] - loop[None], axis=2) < TOUCH_MM
    height = np.where(near, (points[:, 2] + short)[:, None], -np.inf).max(axis=0)
    found = np.isfinite(height)
    return np.asarray(np.where(found, height, height[found].min()))
