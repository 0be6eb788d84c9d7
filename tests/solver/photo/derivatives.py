"""The derivatives of a picture's terms against central differences of their residuals."""

from __future__ import annotations

import numpy as np

from solver.photo.camera import CAMERA_FREEDOM, PinholeCamera
from solver.photo.terms import ImageTerm
from solver.surface import Floats


def check_derivatives(
    term: ImageTerm, skin: Floats, camera: PinholeCamera, step: float, tolerance: float
) -> None:
    """Check what a term says of four ways of a ``skin`` (V, 3), and of each number of a camera."""
    found = term.linearise(skin, camera)
    random = np.random.default_rng(1)
    for _ in range(4):
        way = random.normal(0.0, 1.0, skin.shape)
        ahead, behind = (term.residual(skin + sign * step * way, camera) for sign in (1, -1))
        expected = (ahead - behind) / (2 * step)
        assert np.abs(expected).max() > 1.0
        np.testing.assert_allclose(found.by_skin @ way.ravel(), expected, rtol=tolerance, atol=1e-5)
    for number in range(CAMERA_FREEDOM):
        way = step * np.eye(CAMERA_FREEDOM)[number]
        ahead, behind = (term.residual(skin, camera.moved(sign * way)) for sign in (1, -1))
        expected = (ahead - behind) / (2 * step)
        assert np.abs(expected).max() > 1e-2
        np.testing.assert_allclose(
            found.by_camera[:, number], expected, rtol=tolerance, atol=tolerance
        )
