"""The camera that a fit begins with: where points of a neutral face would look most alike.

Weak perspective: a face is shallow next to its distance, so that its picture is nearly a scaled
orthographic one, u = s R_12 X + u_0, which is linear in its eight numbers. Their two rows are made
orthonormal, and the distance is that at which a focal length gives the scale s.
"""

from __future__ import annotations

import numpy as np

from solver.errors import InputError
from solver.photo.camera import PinholeCamera
from solver.similarity import robust_weights
from solver.surface import Floats

LEAST_POINTS = 6  # of four unknowns a row, with some to spare
ROUNDS = 10  # of robust least squares
TINY = 1e-12  # px: a spread where all landmarks are in one place


def place_camera(
    points: Floats, pixels: Floats, noise_mm: Floats, focal: Floats, centre: Floats
) -> PinholeCamera:
    """Return the camera that sees ``points`` (k, 3), mm, at about ``pixels`` (k, 2).

    ``noise_mm`` (k,) is how far each may be off, ``focal`` (2,) and ``centre`` (2,) are in px.
    Raises :class:`InputError` (``photo.pose``) for too few points, and for pixels that are all in
    one place or on one line. Where they are the mirror image of a face the camera is behind it.
    """
    if len(points) < LEAST_POINTS:
        message = f"{len(points)} landmarks place no camera: at least {LEAST_POINTS} are needed"
        raise InputError("photo.pose", message, found=len(points), expected=LEAST_POINTS)
    middle = points.mean(axis=0)
    design = np.column_stack([points - middle, np.ones(len(points))])
    weights = 1.0 / noise_mm
    for _ in range(ROUNDS):
        found, *_ = np.linalg.lstsq(
            weights[:, None] * design, weights[:, None] * pixels, rcond=None
        )
        away = np.linalg.norm(design @ found - pixels, axis=1)
        px_per_mm = np.linalg.svd(found[:3], compute_uv=False).mean()
        spread = np.maximum(3.0 * px_per_mm * noise_mm, 2.0 * np.median(away))
        weights = np.sqrt(robust_weights((away / np.maximum(spread, TINY)) ** 2)) / noise_mm
    rows = found[:3].T / (focal / focal.mean())[:, None]
    u, scales, vt = np.linalg.svd(rows, full_matrices=False)
    scale = float(scales.mean())
    if not scale > 0.0 or scales[1] < 0.2 * scales[0]:
        message = "the landmarks lie in one place, or on one line: no camera sees a face so"
        raise InputError("photo.pose", message)
    across, down = u @ vt
    rotation = np.stack([across, down, np.cross(across, down)])
    depth = focal.mean() / scale
    seen = np.append((found[3] - centre) / focal * depth, depth)
    return PinholeCamera(focal, centre, rotation, seen - rotation @ middle)
