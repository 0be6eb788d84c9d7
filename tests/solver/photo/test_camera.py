"""Cameras: derivatives by differences, and lens distortion there and back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from solver.photo.camera import CAMERA_FREEDOM, Lens, PinholeCamera

CAMERA = PinholeCamera(
    focal=np.array([1200.0, 1180.0]),
    centre=np.array([320.0, 250.0]),
    rotation=Rotation.from_euler("xyz", [3.0, 0.2, -0.1]).as_matrix(),
    translation=np.array([5.0, -8.0, 900.0]),
)
POINTS = np.random.default_rng(0).normal(0.0, 60.0, (20, 3))


def test_derivatives_are_those_of_differences() -> None:
    by_point, by_camera = CAMERA.derivatives(POINTS)
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        change = CAMERA.project(POINTS + shift) - CAMERA.project(POINTS - shift)
        np.testing.assert_allclose(by_point[..., axis], change[:, :2] / (2 * step), atol=1e-6)
    for number in range(CAMERA_FREEDOM):
        shift = step * np.eye(CAMERA_FREEDOM)[number]
        ahead = CAMERA.moved(shift)
        behind = CAMERA.moved(-shift)
        change = (ahead.project(POINTS) - behind.project(POINTS))[:, :2] / (2 * step)
        assert np.abs(change).max() > 0.1
        np.testing.assert_allclose(by_camera[..., number], change, rtol=1e-6, atol=1e-5)


def test_distortion_is_undone() -> None:
    lens = Lens(CAMERA.focal, CAMERA.centre, np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01]))
    pixels = np.random.default_rng(1).uniform(0.0, 500.0, (50, 2))
    distorted = lens.distort(pixels)
    assert np.abs(distorted - pixels).max() > 1.0
    np.testing.assert_allclose(lens.undistort(distorted), pixels, atol=1e-9)
