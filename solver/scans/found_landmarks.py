"""Landmarks of a scan found by MediaPipe's face landmarker on pictures of it (optional extra).

The scan is drawn from a few sides; what the landmarker sees in the pictures is carried back to the
surface. It runs offline, with the model file ``face_landmarker*.task`` that the user points to.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from solver.drawing.raster import Camera, Pixels, Visible, look
from solver.drawing.render import Body, Lit, render
from solver.errors import InputError
from solver.scans.landmarks import MEDIAPIPE, Points
from solver.surface import Floats, Surface

PIXELS = 512
YAWS = np.radians([0.0, -25.0, 25.0])
GREY = (0.5, 0.5, 0.5)
AGREE_MM = 6.0
"""A landmark counts if two views have it this close together."""


def find_landmarks(scan: Surface, face: Floats, model: Path) -> Points:
    """Return name -> point (3,) of those landmarks that two views agree on.

    Parameters
    ----------
    scan
        In mm, upright, the face forward; with triangles.
    face
        (k, 3) points about where the face is, for the camera.
    model
        The landmarker's ``.task`` file.

    Raises
    ------
    InputError
        ``landmarks.extra`` if MediaPipe is not installed, ``landmarks.model`` if the file is
        missing or no such model.
    """
    landmarker = _landmarker(model)
    low, high = face.min(axis=0), face.max(axis=0)
    body = Body(Lit(scan), np.broadcast_to(GREY, scan.vertices.shape))
    seen: dict[str, list[Floats]] = {}
    for yaw in YAWS:
        camera = Camera((low + high) / 2, span=1.6 * float(high[1] - low[1]), yaw=yaw)
        image = render([body], camera, PIXELS, PIXELS)
        visible = look(camera, scan, PIXELS, PIXELS)
        for name, (column, row) in _detect(landmarker, image).items():
            point = _on_surface(scan, visible, column, row)
            if point is not None:
                seen.setdefault(name, []).append(point)
    landmarker.close()
    found = {name: _agreed(np.array(points)) for name, points in seen.items()}
    return {name: point for name, point in found.items() if point is not None}


def _landmarker(model: Path) -> Any:
    if importlib.util.find_spec("mediapipe") is None:
        raise InputError(
            "landmarks.extra", "finding landmarks needs the extra: pip install 'myoface[mediapipe]'"
        )
    if not model.is_file():
        raise InputError(
            "landmarks.model", f"there is no face landmarker file {model}", file=str(model)
        )
    from mediapipe.tasks.python import BaseOptions, vision

    options = vision.FaceLandmarkerOptions(
        base_options=BaseOptions(model_asset_buffer=model.read_bytes())
    )
    try:
        return vision.FaceLandmarker.create_from_options(options)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            "landmarks.model", f"{model.name} is no face landmarker: {error}", file=str(model)
        ) from error


def _detect(landmarker: Any, image: Pixels) -> dict[str, tuple[float, float]]:
    """Return name -> pixel column and row; nothing where no face is seen."""
    import mediapipe

    pixels = np.ascontiguousarray(image * 255 + 0.5, np.uint8)
    found = landmarker.detect(
        mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=pixels)
    ).face_landmarks
    if not found:
        return {}
    return {
        name: (PIXELS * found[0][number].x, PIXELS * found[0][number].y)
        for number, name in MEDIAPIPE.items()
    }


def _on_surface(scan: Surface, visible: Visible, column: float, row: float) -> Floats | None:
    """Return the point of the surface in a pixel; None where a hole is."""
    x, y = int(column), int(row)
    if not (0 <= x < PIXELS and 0 <= y < PIXELS) or visible.triangle[y, x] < 0:
        return None
    corners = scan.vertices[visible.faces[visible.triangle[y, x]]]
    return np.asarray(visible.weights[y, x].astype(float) @ corners)


def _agreed(points: Floats) -> Floats | None:
    middle = np.median(points, axis=0)
    close = np.linalg.norm(points - middle, axis=1) < AGREE_MM
    return None if close.sum() < 2 else np.asarray(points[close].mean(axis=0))
