"""Rigid motion, and uniform scale where asked for, of a scan onto a model of fixed shape."""

from __future__ import annotations

import numpy as np

from solver.registration.correspondence import motion_columns, pair
from solver.registration.scan_surface import ScanSurface
from solver.similarity import Similarity, small_motion
from solver.surface import Floats

REACHES_MM = (12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0)


def align(
    scan: ScanSurface,
    motion: Similarity,
    points: Floats,
    normals: Floats,
    trust: Floats | None = None,
    *,
    sizes: bool,
) -> Similarity:
    """Return ``motion`` improved by robust point-to-plane steps (Chen & Medioni 1992).

    Parameters
    ----------
    points, normals
        (n, 3) of the model, in mm.
    trust
        (n,) weights of the model's points, all 1 by default.
    sizes
        Whether the scan's size may change.
    """
    for reach in REACHES_MM:
        pairs = pair(scan, motion, points, normals, reach)
        weights = pairs.weights if trust is None else pairs.weights * trust
        columns = motion_columns(pairs, sizes=sizes)
        weighted = columns * weights[:, None]
        normal = weighted.T @ columns
        normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal) + 1e-12
        step = np.asarray(np.linalg.solve(normal, -weighted.T @ pairs.offset), np.float64)
        motion = motion.then(small_motion(step[:6], float(step[6]) if sizes else 0.0))
    return motion
