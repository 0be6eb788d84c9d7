"""Whether the eyes are closed, by where the lids' edge lies in the scan itself.

Seen from the front the surface falls back sharply under the edge of an upper lid. Of an open eye
this edge lies above the line between the corners of the eye; of a closed one it has come down to
the lower lid, and above it the lid is smooth.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter1d
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.scans.landmarks import landmark_vertices
from solver.scans.relief import relief
from solver.surface import Floats, Surface

STEP_MM = 0.5
ABOVE_MM, BELOW_MM = 15.0, 22.0
MIDDLE = 0.5  # of the eye's width
SMOOTH_MM, WIDE_MM, ARCH_MM = 0.6, 3.5, 3.5
STEEPEST = 2.0
UPPER_MM = (-2.0, 11.0)
LOWER_MM = (-13.0, -4.0)
"""Heights over the line between the corners where the edge of an open and of a closed lid lies."""
SHARP, AHEAD, THIN_MM = 0.6, 1.6, 7.5
NEAR_MM, COARSE_MM, FEWEST = 16.0, 2.2, 60


def closed_eyes(scan: Surface, skin: Floats, template: Template) -> dict[str, bool]:
    """Return ``left`` and ``right`` -> whether that eye is surely closed.

    ``scan`` lies in the frame of ``skin`` (n, 3), the template's skin fitted to it. An eye that is
    scanned too coarsely, or whose corners the template does not name, counts as open.
    """
    known = landmark_vertices(template)
    found = {}
    for side in ("left", "right"):
        names = [f"{corner}canthion_{side[0]}" for corner in ("endo", "exo")]
        if all(name in known for name in names):
            corners = skin[[known[name] for name in names]]
            found[side] = _is_closed(scan, corners)
    return found


def _is_closed(scan: Surface, corners: Floats) -> bool:
    middle = corners.mean(axis=0)
    if _spacing(scan.vertices, middle) > COARSE_MM:
        return False
    width = MIDDLE * abs(float(corners[0, 0] - corners[1, 0]))
    centre = middle + np.array([0.0, (ABOVE_MM - BELOW_MM) / 2, 0.0])
    front = relief(scan, centre, (width, ABOVE_MM + BELOW_MM), STEP_MM)
    if np.isfinite(front.height).mean() < 0.5:
        return False
    fall, height = _falls(front.height), front.y - middle[1]
    upper = _within(fall, height, UPPER_MM)
    lower = _within(fall, height, LOWER_MM)
    sharp = height[fall > 0.5 * fall.max()]
    return bool(lower > max(SHARP, AHEAD * upper) and np.ptp(sharp) < THIN_MM)


def _falls(height: Floats) -> Floats:
    """Return how steeply (rows,) the surface falls downwards, sharper than brow and cheek do."""
    rows = np.arange(len(height))
    filled = np.zeros_like(height)
    for column, values in enumerate(height.T):
        known = np.isfinite(values)
        if known.any():
            filled[:, column] = np.interp(rows, rows[known], values[known])
    smooth = gaussian_filter(filled, SMOOTH_MM / STEP_MM)
    sharp = smooth - gaussian_filter(smooth, (WIDE_MM / STEP_MM, 0.0))
    fall = -np.gradient(sharp, STEP_MM, axis=0)
    arched = maximum_filter1d(fall.clip(0, STEEPEST), round(ARCH_MM / STEP_MM), axis=0)
    return np.asarray(np.median(arched, axis=1))


def _within(fall: Floats, height: Floats, band: tuple[float, float]) -> float:
    return float(fall[(height > band[0]) & (height < band[1])].max())


def _spacing(vertices: Floats, centre: Floats) -> float:
    """Return the median distance of neighbouring vertices about an eye."""
    near = vertices[np.linalg.norm(vertices - centre, axis=1) < NEAR_MM]
    if len(near) < FEWEST:
        return float("inf")
    return float(np.median(KDTree(near).query(near, k=2)[0][:, 1]))
