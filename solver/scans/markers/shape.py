"""Takes that no face makes: all markers on a line or in a plane, or none that ever moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.errors import InputError
from solver.scans.markers.motion import Motion
from solver.surface import Floats


@dataclass(frozen=True)
class ExtentOptions:
    """Limits of what is a face."""

    line: float = 0.05  # of markers' extent along a line: their second extent; four on a brow 0.5
    plane: float = 0.01  # the same of the third one ...
    least: int = 6  # ... of so many markers; faces have 0.2
    far: float = 5.0  # times the usual distance from the middle: a marker is thrown, and left out
    still_mm: float = 0.3  # no marker goes farther from its middle place: nothing moves
    usual: float = 0.98  # quantile of its frames in that


SHAPE = ExtentOptions()


def refuse_flat(file: str, points: Floats, options: ExtentOptions = SHAPE) -> None:
    """Raise :class:`InputError` ``markers.flat`` for markers (k, 3) on a line or in a plane."""
    seen = points[np.isfinite(points[:, 0])]
    if not len(seen):
        return
    away = np.linalg.norm(seen - np.median(seen, axis=0), axis=1)
    seen = seen[away <= options.far * np.median(away)]  # a thrown one makes a line of any
    if len(seen) < 3:
        return
    extents = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    longest = max(float(extents[0]), 1e-12)
    is_line = extents[1] < options.line * longest
    if is_line or (len(seen) >= options.least and extents[2] < options.plane * longest):
        where = "on a line" if is_line else "in a plane"
        message = f"the {len(seen)} markers of {file} lie {where}: they are of no face in space"
        raise InputError("markers.flat", message, file=file, found=len(seen))


def is_motionless(motion: Motion, options: ExtentOptions = SHAPE) -> bool:
    """Tell whether no marker moves against the others, in more than a frame."""
    off = np.linalg.norm(motion.places - motion.middle, axis=2)
    off = off[:, np.isfinite(off).any(axis=0)]
    if len(off) < 2 or not off.shape[1]:
        return False
    return bool((np.nanquantile(off, options.usual, axis=0) <= options.still_mm).all())
