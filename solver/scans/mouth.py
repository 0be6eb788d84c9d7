"""Whether the lips are apart, by the profile of the scan itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_closing, maximum_filter1d
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.registration.landmarks import landmark_vertices
from solver.scans.cover import relief
from solver.surface import Floats, Ints, Surface

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


# Whether the eyes are closed, by where the lids' edge lies in the scan itself.
#
# Seen from the front the surface falls back sharply under the edge of an upper lid. Of an open eye
# this edge lies above the line between the corners of the eye; of a closed one it has come down to
# the lower lid, and above it the lid is smooth.


EYE_ABOVE_MM, EYE_BELOW_MM = 15.0, 22.0
MIDDLE = 0.5  # of the eye's width
SMOOTH_MM, WIDE_MM, ARCH_MM = 0.6, 3.5, 3.5
STEEPEST = 2.0
UPPER_MM = (-2.0, 11.0)
LOWER_MM = (-13.0, -4.0)
"""Heights over the line between the corners where the edge of an open and of a closed lid lies."""
SHARP, AHEAD, THIN_MM = 0.6, 1.6, 7.5
EYE_NEAR_MM, COARSE_MM, FEWEST = 16.0, 2.2, 60


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
    centre = middle + np.array([0.0, (EYE_ABOVE_MM - EYE_BELOW_MM) / 2, 0.0])
    front = relief(scan, centre, (width, EYE_ABOVE_MM + EYE_BELOW_MM), STEP_MM)
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
    near = vertices[np.linalg.norm(vertices - centre, axis=1) < EYE_NEAR_MM]
    if len(near) < FEWEST:
        return float("inf")
    return float(np.median(KDTree(near).query(near, k=2)[0][:, 1]))


# How rough a scan is: noise against a smooth surface, and spikes.


PROBES = 800
NEIGHBOURS = 24
RADIUS_MM = 3.0
SPIKE_EDGES, SPIKE_MM, SPIKE_ANGLE = 3.0, 6.0, np.radians(200.0)
UNKNOWNS = 6  # of a quadratic height field


@dataclass(frozen=True)
class Roughness:
    """``noise_mm`` of the face (median over places, NaN if too coarse to tell) and its spacing.

    ``spacing_mm`` is the median distance between neighbouring vertices.
    """

    noise_mm: float
    spacing_mm: float


def roughness(points: Floats, places: Floats, seed: int = 0) -> Roughness:
    """Return the roughness of the vertices (n, 3) of a scan at ``places`` (k, 3) of a face, in mm.

    At some of the places a quadratic height field is fitted to the neighbours within RADIUS_MM (in
    a coarse scan farther); what it leaves is noise, as skin is smooth at that size.
    """
    chosen = np.random.default_rng(seed).permutation(len(places))[:PROBES]
    tree = KDTree(points)
    centres = points[tree.query(places[chosen])[1]]
    distance, near = tree.query(centres, k=min(NEIGHBOURS, len(points)))
    spacing = float(np.median(distance[:, 1]))
    radius = max(RADIUS_MM, 2.5 * spacing)
    dense = (distance < radius).sum(axis=1) >= 2 * UNKNOWNS
    if dense.sum() < len(chosen) / 8:
        return Roughness(float("nan"), spacing)
    rms = [_misfit(points[near[k][distance[k] < radius]]) for k in np.flatnonzero(dense).tolist()]
    return Roughness(float(np.median(rms)), spacing)


def _misfit(points: Floats) -> float:
    """Return the standard deviation of points (n, 3) about a quadratic height field."""
    offsets = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    u, v, height = (offsets @ axes.T).T
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, height, rcond=None)[0]
    return float(np.sqrt(((height - fitted) ** 2).sum() / max(len(u) - UNKNOWNS, 1)))


def spikes(vertices: Floats, faces: Ints) -> NDArray[np.bool_]:
    """Return which vertices (n,) in mm stick out as spikes.

    A spike stands far from the middle of its neighbours, by SPIKE_MM and by SPIKE_EDGES times the
    scan's edges, and its triangles leave it within a narrow cone.
    """
    ends = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
    lengths = np.linalg.norm(ends, axis=2)
    unit = ends / (lengths[:, :, None] + 1e-30)
    cosine = -(unit * np.roll(unit, 1, axis=1)).sum(axis=2)
    corners, count = faces.ravel(), len(vertices)
    angle = np.bincount(corners, np.arccos(cosine.clip(-1, 1)).ravel(), minlength=count)
    degree = np.maximum(np.bincount(corners, minlength=count), 1)
    away = np.empty((count, 3))
    for axis in range(3):
        away[:, axis] = np.bincount(corners, ends[:, :, axis].ravel(), minlength=count) / degree
    height = np.linalg.norm(away, axis=1)
    limit = max(SPIKE_EDGES * float(np.median(lengths)), SPIKE_MM)
    return np.asarray((height > limit) & (angle < SPIKE_ANGLE) & (angle > 0))
