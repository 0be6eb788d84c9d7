"""Where a raw scan's face is and in what unit it was written, from landmarks or by its shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.anatomy.warp import similarity
from solver.errors import InputError
from solver.registration.correspondence import Pins
from solver.registration.pose import FacePatch, find_face
from solver.registration.rigid import align
from solver.registration.scan_surface import ScanSurface, scan_surface
from solver.scans.faults import empty
from solver.scans.raw import RawScan
from solver.scans.units import AXES, EXTENT_MM, UNITS, unit_of
from solver.similarity import Similarity
from solver.surface import Floats

CLOSE_MM, FAR_MM = 5.7, 6.5
"""A face that fits better than the first on average is found; one worse than the second is none."""
HEAD_MM = (170.0, 230.0, 310.0, 420.0, 570.0)
"""Extents to try for a scan in which no face of a person's size was found."""


@dataclass(frozen=True)
class Start:
    """A scan in mm and its motion onto the face.

    ``unit`` is None where ``mm_per_unit`` is no unit's, ``size_known`` false where the size is
    only the face's it was laid on: it fits neither a unit nor a decimal slip of one.
    """

    scan: ScanSurface
    motion: Similarity
    mm_per_unit: float
    unit: str | None
    size_known: bool


def start_by_shape(raw: RawScan, patch: FacePatch, frame: Mapping[str, Any]) -> Start:
    """Find the face of a mended scan by its shape alone.

    ``frame`` holds the options ``unit``, ``up`` and ``forward``. Raises :class:`InputError`:
    ``options.unit``, ``options.axes``, ``scan.not_a_face``, ``scan.empty``.
    """
    upright = (_axis(frame, "up"), _axis(frame, "forward"))
    if not len(raw.vertices):
        raise empty(raw.file)
    best: tuple[float, float, ScanSurface, Similarity] | None = None
    likely, others = _factors(raw, str(frame["unit"]))
    for factors in (likely, others):
        for factor in factors:
            scan = scan_surface(raw, factor)
            motion, misfit = find_face(patch, scan, upright)
            if best is None or misfit < best[0]:
                best = misfit, factor, scan, motion
        if best is not None and best[0] < CLOSE_MM:
            break
    assert best is not None
    misfit, factor, scan, motion = best
    if misfit > FAR_MM:
        unit = f", read in {frame['unit']}," if frame["unit"] in UNITS else ""
        raise not_a_face(raw.file, f"the best place for one{unit} is {misfit:.1f} mm off")
    motion = align(scan, motion, patch.points, patch.normals, sizes=True)
    fitted = motion.scale * factor
    total, name = _unit(raw, fitted, frame)
    scan = scan if total == factor else scan_surface(raw, total)
    resized = _resized(motion, total / factor, patch.points.mean(axis=0))
    return Start(scan, resized, total, name, size_known=total != fitted)


def start_by_landmarks(raw: RawScan, pins: Pins, model: Floats, frame: Mapping[str, Any]) -> Start:
    """Place a mended scan by landmarks on the ``model`` (n, 3); the points are as in the file."""
    motion = Similarity(*similarity(pins.points, model[pins.vertices]))
    mm_per_unit, name = _unit(raw, motion.scale, frame)
    resized = _resized(motion, mm_per_unit, model[pins.vertices].mean(axis=0))
    known = mm_per_unit != motion.scale
    return Start(scan_surface(raw, mm_per_unit), resized, mm_per_unit, name, size_known=known)


def _unit(raw: RawScan, scale: float, frame: Mapping[str, Any]) -> tuple[float, str | None]:
    return unit_of(scale, str(frame["unit"]), raw.mm_per_unit)


def _resized(motion: Similarity, factor: float, centre: Floats) -> Similarity:
    """Return the motion of a scan ``factor`` times as large, without scale, about ``centre``."""
    there = factor * motion.inverse()(centre[None])[0]
    return Similarity(1.0, motion.rotation, centre - motion.rotation @ there)


def _factors(raw: RawScan, unit: str) -> tuple[list[float], list[float]]:
    """Return the mm per unit to try first, and those to try if none fits well."""
    if unit in UNITS:
        return [UNITS[unit]], []
    if unit != "auto":
        raise InputError(
            "options.unit",
            f"unit is {unit!r}, not one of auto, {', '.join(UNITS)}",
            expected=["auto", *UNITS],
        )
    low, high = np.quantile(raw.vertices, [0.005, 0.995], axis=0)
    extent = max(float((high - low).max()), 1e-30)
    declared = [] if raw.mm_per_unit is None else [raw.mm_per_unit]
    likely = [f for f in declared or UNITS.values() if EXTENT_MM[0] <= f * extent <= EXTENT_MM[1]]
    return likely, [mm / extent for mm in HEAD_MM]


def not_a_face(file: str, reason: str) -> InputError:
    """Return the error for a scan in which no face was found."""
    return InputError("scan.not_a_face", f"{file} shows no whole face: {reason}", file=file)


def _axis(frame: Mapping[str, Any], name: str) -> Floats | None:
    given = str(frame[name])
    if given == "auto":
        return None
    if given not in AXES:
        raise InputError(
            "options.axes",
            f"{name} is {given!r}, not one of auto, {', '.join(AXES)}",
            expected=["auto", *AXES],
        )
    return np.array(AXES[given])
