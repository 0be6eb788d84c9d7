"""Open lips, closed eyes and roughness, by the surface of the scan itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_closing, label, maximum_filter1d
from scipy.spatial import KDTree

from solver.anatomy.contact_regions import eye_corners, stomia
from solver.anatomy.template import Template
from solver.registration.landmarks import landmark_vertices
from solver.scans.cover import relief
from solver.surface import Floats, Ints, Surface, unit_rows


@dataclass(frozen=True)
class LipOptions:
    """The profile down the middle of the mouth; lengths in mm."""

    step: float = 0.5  # of rows and columns
    strip: float = 9.0  # width of the profile
    above: float = 14.0  # the lips' middle
    below: float = 50.0  # the lips' middle
    widest: float = 60.0  # gap
    deep: float = 6.0  # fall of a gap behind the lips
    steep: float = 3.0  # fall of its edge within a millimetre
    near: float = 11.0  # of the deepest place to the template's lips
    apart: float = 2.0  # of lips that are open
    throat: float = 18.0  # fall behind the lips that shows between teeth; these lie 8 to 15 back


LIPS = LipOptions()


@dataclass(frozen=True)
class MouthGaps:
    """Gaps between lips and between teeth, in mm; None where the scan does not show it."""

    lips_mm: float | None  # 0: they are closed; no scan shows that of the teeth
    teeth_mm: float | None = None
    is_open: bool = False  # the lips are apart
    why_not: str = ""  # nothing is known of the lips


def find_mouth(scan: Surface, template: Template) -> MouthGaps:
    """Return how far apart the lips are, and the teeth behind them.

    ``scan`` lies in the template's frame. Down the middle of the mouth, a gap is where the profile
    falls deep behind lips on both sides of it, over a steep edge.
    """
    lips = stomia(template.landmarks)
    if len(lips) < 2:
        return MouthGaps(None, why_not="the template does not name the lips")
    centre = template.skin.vertices[lips].mean(axis=0)
    top = centre[1] + LIPS.above
    bottom = centre[1] - LIPS.below
    middle = np.array([centre[0], (top + bottom) / 2, centre[2]])
    front = relief(scan, middle, (LIPS.strip, top - bottom), LIPS.step)
    known = np.isfinite(front.height).sum(axis=1) * 2 > len(front.x)
    if known.sum() < len(known) / 2:
        return MouthGaps(None, why_not="too little of the mouth is in the scan")
    profile = np.nanmedian(front.height[known], axis=1)
    profile = np.interp(front.y[::-1], front.y[known][::-1], profile[::-1])[::-1]
    return _find_gap(front.y - centre[1], profile)


def _find_gap(height: Floats, profile: Floats) -> MouthGaps:
    """Return what the gap in a profile (n,) shows, of rows from top to bottom."""
    rows = round(LIPS.widest / LIPS.step)
    depth = grey_closing(profile, rows, mode="nearest") - profile
    deep = (depth > LIPS.deep) & (np.abs(height) < LIPS.above + LIPS.widest)
    near = deep & (np.abs(height) < LIPS.near)
    if not near.any():
        return MouthGaps(0.0)
    runs, _ = label(deep)
    gap = np.flatnonzero(runs == runs[np.argmax(np.where(near, depth, 0))])
    edge = profile[max(gap[0] - 4, 0) : gap[-1] + 5]
    falls = np.abs(edge[2:] - edge[:-2])
    if falls.max(initial=0) <= LIPS.steep:
        return MouthGaps(0.0)
    lips = len(gap) * LIPS.step
    between = LIPS.step * float((depth[gap] > LIPS.throat).sum())
    teeth = between if between >= LIPS.apart else None
    return MouthGaps(lips, teeth, is_open=lips >= LIPS.apart)


# Closed eyes, by where the lids' edge lies in the scan itself.
#
# Seen from the front the surface falls back sharply under the edge of an upper lid. On an open eye
# this edge lies above the line between the corners of the eye; on a closed one it has come down to
# the lower lid, and above it the lid is smooth.


@dataclass(frozen=True)
class UpperLidOptions:
    """The edge of an upper lid; lengths in mm."""

    step: float = 0.5  # of rows and columns
    above: float = 15.0  # the eye's corners
    below: float = 22.0  # the eye's corners
    middle: float = 0.5  # share of the eye's width that is looked at
    smooth: float = 0.6  # width of what is noise
    wide: float = 3.5  # width of brow and cheek's slopes
    arch: float = 3.5  # by which an edge bows
    steepest: float = 2.0  # slope that counts
    upper: tuple[float, float] = (-2.0, 11.0)  # heights over the corners of an open lid's edge
    lower: tuple[float, float] = (-13.0, -4.0)  # heights of a closed lid's edge
    sharp: float = 0.35  # least slope of a closed lid's edge
    ahead: float = 1.6  # times the slope above it
    thin: float = 7.5  # height of one edge, of the rows ...
    edge: float = 0.6  # ... with at least this share of the steepest slope
    near: float = 16.0  # radius of an eye
    coarse: float = 2.5  # spacing that hides an edge
    few: int = 12  # vertices about an eye that tell their spacing
    fewest: int = 60  # vertices about an eye that show its lids


LIDS = UpperLidOptions()


@dataclass(frozen=True)
class Eye:
    """An eye, surely closed or not; None where the scan does not show it, and why."""

    closed: bool | None
    why_not: str = ""


def find_eyes(scan: Surface, skin: Floats, template: Template) -> dict[str, Eye]:
    """Return ``left`` and ``right`` -> that eye, if the template names its corners.

    ``scan`` lies in the frame of ``skin`` (n, 3), the template's skin fitted to it.
    """
    known = eye_corners(landmark_vertices(template))
    return {side: _find_eye(scan, skin[corners]) for side, corners in known.items()}


def _find_eye(scan: Surface, corners: Floats) -> Eye:
    middle = corners.mean(axis=0)
    too_little = Eye(None, "too little of it is in the scan")
    near = scan.vertices[np.linalg.norm(scan.vertices - middle, axis=1) < LIDS.near]
    if len(near) < LIDS.few:
        return too_little
    spacing = float(np.median(KDTree(near).query(near, k=2)[0][:, 1]))
    if spacing > LIDS.coarse:
        return Eye(None, f"a vertex only every {spacing:.1f} mm there does not show the lids")
    width = LIDS.middle * abs(float(corners[0, 0] - corners[1, 0]))
    centre = middle + np.array([0.0, (LIDS.above - LIDS.below) / 2, 0.0])
    front = relief(scan, centre, (width, LIDS.above + LIDS.below), LIDS.step)
    if len(near) < LIDS.fewest or np.isfinite(front.height).mean() < 0.5:
        return too_little
    fall = _falls(front.height)
    height = front.y - middle[1]
    upper, lower = (
        fall[(height > low) & (height < high)].max() for low, high in (LIDS.upper, LIDS.lower)
    )
    at_eye = (height > LIDS.lower[0]) & (height < LIDS.upper[1])  # brows are sharp as well
    sharp = height[at_eye & (fall > LIDS.edge * fall[at_eye].max())]
    is_lower = lower > max(LIDS.sharp, LIDS.ahead * upper)
    return Eye(bool(is_lower and np.ptp(sharp) < LIDS.thin))


def _falls(height: Floats) -> Floats:
    """Return how steeply (rows,) the surface falls downwards, sharper than brow and cheek do."""
    rows = np.arange(len(height))
    filled = np.zeros_like(height)
    for column, values in enumerate(height.T):
        known = np.isfinite(values)
        if known.any():
            filled[:, column] = np.interp(rows, rows[known], values[known])
    smooth = gaussian_filter(filled, LIDS.smooth / LIDS.step)
    sharp = smooth - gaussian_filter(smooth, (LIDS.wide / LIDS.step, 0.0))
    fall = -np.gradient(sharp, LIDS.step, axis=0)
    arched = maximum_filter1d(fall.clip(0, LIDS.steepest), round(LIDS.arch / LIDS.step), axis=0)
    return np.asarray(np.median(arched, axis=1))


UNKNOWNS = 6  # of a quadratic height field


@dataclass(frozen=True)
class RoughOptions:
    """Noise and spikes; lengths in mm."""

    probes: int = 800  # places where noise is measured
    neighbours: int = 24  # of a place
    radius: float = 3.0  # within which skin is a quadratic
    spike_edges: float = 3.0  # height of a spike by the scan's edges
    spike: float = 6.0  # least height of a spike
    spike_angle: float = np.radians(200.0)  # sum of the angles at its tip


ROUGH = RoughOptions()


def roughness(points: Floats, places: Floats) -> tuple[float, float]:
    """Return noise and spacing of the vertices (n, 3) of a scan at ``places`` (k, 3) of a face.

    Both are medians over places in mm, the noise NaN in a scan too coarse to tell. At some of
    the places a quadratic height field is fitted to the neighbours in a radius (larger in a
    coarse scan); what it leaves is noise, as skin is smooth at that size.
    """
    chosen = np.random.default_rng(0).permutation(len(places))[: ROUGH.probes]
    tree = KDTree(points)
    centres = points[tree.query(places[chosen])[1]]
    distance, near = tree.query(centres, k=min(ROUGH.neighbours, len(points)))
    spacing = float(np.median(distance[:, 1]))
    radius = max(ROUGH.radius, 2.5 * spacing)
    inside = distance < radius
    dense = np.flatnonzero(inside.sum(axis=1) >= 2 * UNKNOWNS)
    if len(dense) < len(chosen) / 8:
        return float("nan"), spacing
    noise = np.median([_misfit(points[near[k][inside[k]]]) for k in dense])
    return float(noise), spacing


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

    A spike stands far from the middle of its neighbours, also by the scan's edges,
    and its triangles leave it within a narrow cone.
    """
    ends = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
    lengths = np.linalg.norm(ends, axis=2)
    unit = unit_rows(ends)
    cosine = -(unit * np.roll(unit, 1, axis=1)).sum(axis=2)
    corners = faces.ravel()
    count = len(vertices)
    angle = np.bincount(corners, np.arccos(cosine.clip(-1, 1)).ravel(), minlength=count)
    degree = np.maximum(np.bincount(corners, minlength=count), 1)
    sums = [np.bincount(corners, side.ravel(), minlength=count) for side in ends.T.swapaxes(1, 2)]
    height = np.linalg.norm(sums, axis=0) / degree
    limit = max(ROUGH.spike_edges * float(np.median(lengths)), ROUGH.spike)
    return np.asarray((height > limit) & (angle < ROUGH.spike_angle) & (angle > 0))
