"""Whether the lips are apart, by the profile of the scan itself."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import grey_closing

from solver.anatomy.template import Template
from solver.scans.relief import relief
from solver.surface import Floats, Surface

STEP_MM = 0.5
STRIP_MM = 9.0
ABOVE_MM, BELOW_MM = 14.0, 50.0
WIDEST_MM = 60.0
DEEP_MM = 6.0
STEEP_MM = 3.0
NEAR_MM = 11.0
"""How far from the template's lips the deepest place of a gap may be."""


def lip_gap(scan: Surface, template: Template) -> float:
    """Return the height in mm of the gap between the lips, 0 if they are closed.

    ``scan`` lies in the template's frame. Down the middle of the mouth, a gap is where the profile
    falls DEEP_MM or more behind lips on both sides of it, over a steep edge. Without the landmarks
    of the lips nothing is known, and 0 is returned.
    """
    upper, lower = (template.landmarks.get(f"stomion_{lip}us") for lip in ("superi", "inferi"))
    if upper is None or lower is None:
        return 0.0
    centre = (template.skin.vertices[upper] + template.skin.vertices[lower]) / 2
    top, bottom = centre[1] + ABOVE_MM, centre[1] - BELOW_MM
    middle = np.array([centre[0], (top + bottom) / 2, centre[2]])
    front = relief(scan, middle, (STRIP_MM, top - bottom), STEP_MM)
    known = np.isfinite(front.height).sum(axis=1) * 2 > len(front.x)
    if known.sum() < len(known) / 2:
        return 0.0
    profile = np.array(
        [np.nanmedian(row) if ok else 0.0 for row, ok in zip(front.height, known, strict=True)]
    )
    profile = np.interp(front.y[::-1], front.y[known][::-1], profile[known][::-1])[::-1]
    return _gap(front.y - centre[1], profile)


def _gap(height: Floats, profile: Floats) -> float:
    """Return the height in mm of the gap in a profile (n,) of rows from top to bottom."""
    rows = round(WIDEST_MM / STEP_MM)
    depth = grey_closing(profile, rows, mode="nearest") - profile
    deep = (depth > DEEP_MM) & (np.abs(height) < ABOVE_MM + WIDEST_MM)
    near = deep & (np.abs(height) < NEAR_MM)
    if not near.any():
        return 0.0
    start = end = int(np.argmax(np.where(near, depth, 0)))
    while start > 0 and deep[start - 1]:
        start -= 1
    while end + 1 < len(deep) and deep[end + 1]:
        end += 1
    edge = slice(max(start - 4, 0), end + 5)
    falls = np.abs(profile[edge][2:] - profile[edge][:-2])
    return float((end - start + 1) * STEP_MM) if falls.max(initial=0) > STEEP_MM else 0.0
