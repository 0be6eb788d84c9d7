"""Whether the eyes are closed: the scan beside the template's open and closed eyes."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.scans.likeness import Likeness
from solver.scans.relief import Relief, relief
from solver.surface import Floats, Surface

STEP_MM = 1.0
WINDOW_MM = (40.0, 28.0)
SEARCH_MM = 5
SMOOTH = 1.0
STEEPEST = 1.0
ALIKE = 0.75
AHEAD = 0.15
NEAR_MM, COARSE_MM, FEWEST = 16.0, 2.2, 60


def closed_eyes(scan: Surface, fitted: Likeness, template: Template) -> dict[str, bool]:
    """Return ``left`` and ``right`` -> whether that eye is surely closed.

    ``scan`` lies in the fitted template's frame. The slopes around the eye are compared with those
    of the fitted template with that eye open and closed (normalised cross-correlation, at the best
    of small shifts). A scan too coarse or too unlike either says nothing and counts as open.
    """
    shapes = template.shapes
    if shapes is None:
        return {}
    found = {}
    for side in ("Left", "Right"):
        name = f"eyeBlink{side}"
        if name not in shapes.expression_names:
            continue
        blink = shapes.expressions[shapes.expression_names.index(name)]
        strength = np.linalg.norm(blink, axis=1)
        centre = fitted.neutral[strength > 0.3 * strength.max()].mean(axis=0)
        if _spacing(scan.vertices, centre) > COARSE_MM:
            found[side.lower()] = False
            continue
        margin = 2 * SEARCH_MM
        there = _slopes(relief(scan, centre, (WINDOW_MM[0] + margin, WINDOW_MM[1] + margin), 1.0))
        likeness = [
            _best_match(
                there, _slopes(relief(Surface(eye, template.skin.faces), centre, WINDOW_MM, 1.0))
            )
            for eye in (fitted.neutral, fitted.neutral + blink)
        ]
        found[side.lower()] = likeness[1] > ALIKE and likeness[1] > likeness[0] + AHEAD
    return found


def _spacing(vertices: Floats, centre: Floats) -> float:
    """Return the median distance of neighbouring vertices about an eye."""
    near = vertices[np.linalg.norm(vertices - centre, axis=1) < NEAR_MM]
    if len(near) < FEWEST:
        return float("inf")
    return float(np.median(KDTree(near).query(near, k=2)[0][:, 1]))


def _slopes(front: Relief) -> Floats:
    """Return the smoothed slopes (rows, columns, 2), 0 where nothing is known."""
    known = np.isfinite(front.height)
    weight = gaussian_filter(known.astype(float), SMOOTH)
    height = gaussian_filter(np.where(known, front.height, 0.0), SMOOTH) / np.maximum(weight, 1e-3)
    slopes = np.stack(np.gradient(height, STEP_MM), axis=2).clip(-STEEPEST, STEEPEST)
    slopes[weight < 0.5] = 0.0
    return np.asarray(slopes)


def _best_match(there: Floats, wanted: Floats) -> float:
    rows, columns = wanted.shape[:2]
    steps = range(2 * SEARCH_MM + 1)
    return max(
        _correlation(there[down : down + rows, right : right + columns], wanted)
        for down in steps
        for right in steps
    )


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(axis=(0, 1)), b - b.mean(axis=(0, 1))
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-12))
