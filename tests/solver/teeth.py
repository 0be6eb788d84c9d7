"""A wall around the vertical axis: its front is a row of teeth without gaps."""

import numpy as np
import trimesh

from solver.surface import Surface

RADIUS = 25.0
HEIGHT = 10.0


def row_of_teeth(at=(0.0, 0.0, 0.0)):
    """Return the wall, its middle ``at`` a place."""
    wall = trimesh.creation.annulus(RADIUS - 6.0, RADIUS, HEIGHT, sections=96)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return Surface(np.asarray(wall.vertices) @ turn.T + at, np.asarray(wall.faces, np.int64))


def fan(radius, height=0.0, half=50.0, count=21):
    """Return points around the same axis, up to ``half`` degrees to each side of the front."""
    angle = np.radians(np.linspace(-half, half, count))
    return np.stack(
        [radius * np.sin(angle), np.full(count, height), radius * np.cos(angle)], axis=1
    )
