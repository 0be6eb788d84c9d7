"""Where a raw scan's face is and in what unit it was written, from landmarks or by its shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.anatomy.warp import similarity
from solver.errors import InputError
from solver.registration.pose import FacePatch, find_face
from solver.registration.rigid import align
from solver.registration.scan_surface import ScanSurface, scan_surface
from solver.registration.similarity import Similarity
from solver.scans.raw import RawScan
from solver.scans.units import AXES, EXTENT_MM, UNITS, unit_of
from solver.surface import Floats, Ints

FAR_MM = 7.0
"""A face that fits no better than this on average is none."""
HEAD_MM = (170.0, 230.0, 310.0, 420.0, 570.0)
"""Extents to try for a scan whose numbers make no head in any unit."""


@dataclass(frozen=True)
class Pins:
    """Landmarks: ``points`` (k, 3) of the scan and the ``vertices`` (k,) they mark."""

    points: Floats
    vertices: Ints


@dataclass(frozen=True)
class Start:
    """A scan in mm and its motion onto the face; ``unit`` is None where its size fits no unit."""

    scan: ScanSurface
    motion: Similarity
    mm_per_unit: float
    unit: str | None


def start_by_shape(raw: RawScan, patch: FacePatch, frame: Mapping[str, Any]) -> Start:
    """Find the face of a mended scan by its shape alone.

    ``frame`` holds the options ``unit``, ``up`` and ``forward``. Raises :class:`InputError`:
    ``options.unit``, ``options.axes``, ``scan.not_a_face``.
    """
    upright = (_axis(frame, "up"), _axis(frame, "forward"))
    best: tuple[float, float, ScanSurface, Similarity] | None = None
    for factor in _factors(raw, str(frame["unit"])):
        scan = scan_surface(raw, factor)
        motion, misfit = find_face(patch, scan, upright)
        if best is None or misfit < best[0]:
            best = misfit, factor, scan, motion
    assert best is not None
    misfit, factor, scan, motion = best
    if misfit > FAR_MM:
        raise InputError(
            "scan.not_a_face",
            f"{raw.file} shows no face: the best place for one is {misfit:.1f} mm off on average",
            file=raw.file,
            found=misfit,
            expected=FAR_MM,
        )
    motion = align(scan, motion, patch.points, patch.normals, sizes=True)
    return _in_unit(raw, factor, motion, patch.points.mean(axis=0), str(frame["unit"]))


def start_by_landmarks(raw: RawScan, pins: Pins, model: Floats, frame: Mapping[str, Any]) -> Start:
    """Place a mended scan by landmarks on the ``model`` (n, 3); the points are as in the file."""
    motion = Similarity(*similarity(pins.points, model[pins.vertices]))
    centre = model[pins.vertices].mean(axis=0)
    return _in_unit(raw, 1.0, motion, centre, str(frame["unit"]))


def _in_unit(raw: RawScan, factor: float, motion: Similarity, centre: Floats, unit: str) -> Start:
    """Give a scan of known unit its true size, about the face's ``centre`` (3,)."""
    total = motion.scale * factor
    mm_per_unit, name = unit_of(total, unit, raw.mm_per_unit)
    about = motion.inverse()(centre[None])[0] * mm_per_unit / factor
    shift = centre - motion.rotation @ about
    scan = scan_surface(raw, mm_per_unit)
    return Start(scan, Similarity(1.0, motion.rotation, shift), mm_per_unit, name)


def _factors(raw: RawScan, unit: str) -> list[float]:
    """Return the mm per unit to try."""
    if unit in UNITS:
        return [UNITS[unit]]
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
    return likely or [mm / extent for mm in HEAD_MM]


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
