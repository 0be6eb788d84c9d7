"""Short threads along the fibres of muscles, for pictures."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface

LEAST_SHARE = 0.1
"""A thread runs through each tet of which the muscle has this share."""
STEP_MM, STEPS = 1.0, 4
"""A thread follows the fibres this far both ways."""
RADIUS_MM = 0.35
NEIGHBOURS = 6
_SIDES = 3


def fibre_threads(model: SubjectModel) -> dict[str, Surface]:
    """Return muscle -> thin tubes along its fibres, in mm.

    Muscles without a tet of :data:`LEAST_SHARE` are left out, and all if the model has no fibres.
    """
    if model.fibres is None:
        return {}
    entries = model.weights.tocoo()
    centres = model.rest[model.tets].mean(axis=1)
    threads = {}
    for column, name in enumerate(model.muscle_names, start=1):
        own = np.flatnonzero((entries.col == column) & (entries.data >= LEAST_SHARE))
        if len(own):
            points = centres[entries.row[own]]
            threads[name] = _tubes(_traced(points, model.fibres[own]))
    return threads


def _traced(points: Floats, directions: Floats) -> Floats:
    """Return polylines (k, 2 STEPS + 1, 3) through the points of a field."""
    tree = cKDTree(points)
    count = min(NEIGHBOURS, len(points))
    halves = []
    for sign in (-1.0, 1.0):
        place, ahead, line = points, directions, []
        for _ in range(STEPS):
            near = tree.query(place, k=range(1, count + 1))[1]
            ahead = directions[near].mean(axis=1)
            ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
            place = place + sign * STEP_MM * ahead
            line.append(place)
        halves.append(line)
    return np.stack([*halves[0][::-1], points, *halves[1]], axis=1)


def _tubes(lines: Floats) -> Surface:
    """Return triangles around polylines (k, s, 3), thinner towards both ends."""
    count, steps, _ = lines.shape
    along = np.gradient(lines, axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    least = np.eye(3)[np.abs(along).argmin(axis=2)]
    across = np.cross(along, least)
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    other = np.cross(along, across)
    width = RADIUS_MM * np.sin(np.linspace(0.15, np.pi - 0.15, steps)) ** 0.5
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle = (
        np.cos(angle)[:, None] * across[:, :, None] + np.sin(angle)[:, None] * other[:, :, None]
    )
    vertices = lines[:, :, None] + width[:, None, None] * circle
    number: Ints = np.arange(count * steps * _SIDES).reshape(count, steps, _SIDES)
    a, b = number[:, :-1], number[:, 1:]
    after_a, after_b = np.roll(a, -1, axis=2), np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, after_a, after_b], -1), np.stack([a, after_b, b], -1)])
    return Surface(vertices.reshape(-1, 3), faces.reshape(-1, 3))
