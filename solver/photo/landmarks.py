"""Landmarks of photographs: where they are on the skin, and those that a detector finds."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import InputError
from solver.photo.photo import Photo
from solver.registration.detector import SKIN_POINTS, DetectedFace, FaceDetector
from solver.registration.landmarks import landmark_vertices

MODEL_VARIABLE = "MYOFACE_FACE_LANDMARKER"
EYE_CORNERS = (33, 263)  # outer ones of the detector's mesh, the subject's right and left


@dataclass(frozen=True)
class FaceLimits:
    """Faces that a fit can do something with."""

    least_px: float = 30.0  # between the outer corners of the eyes
    most_yaw_deg: float = 60.0  # beyond, half of the landmarks are guesses
    named_mm: float = 2.0  # standard deviation of a landmark that a person marks by its name


LIMITS = FaceLimits()


def landmark_points(template: Template, limits: FaceLimits = LIMITS) -> SkinPoints:
    """Return where landmarks of photographs are on the template's skin.

    They are the template's own by name, and a detector's where the template has its points.
    """
    named = landmark_vertices(template)
    corners = np.repeat(np.array([*named.values()], np.int64)[:, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(named), 1))
    own = SkinPoints(tuple(named), corners, weights, np.full(len(named), limits.named_mm))
    if template.points is None:
        return own
    found = template.points
    return SkinPoints(
        (*own.names, *found.names),
        np.vstack([own.corners, found.corners]),
        np.vstack([own.weights, found.weights]),
        np.concatenate([own.spread_mm, found.spread_mm]),
    )


def find_landmarks(photo: Photo, limits: FaceLimits = LIMITS) -> Photo:
    """Return the photograph with the landmarks that MediaPipe finds of its one face.

    Raises :class:`InputError`: ``photo.no_face``, ``photo.faces`` (several, with their ``boxes``),
    ``photo.small_face``, ``photo.profile``; ``landmarks.extra`` if MediaPipe is not installed,
    ``landmarks.model`` if no file of its model is named by ``MYOFACE_FACE_LANDMARKER``.
    """
    given = os.environ.get(MODEL_VARIABLE)
    if not given:
        message = (
            f"{photo.name} has no landmarks, and nothing that finds them: give a JSON file with "
            f"them beside it, or the landmarker's file in {MODEL_VARIABLE}"
        )
        raise InputError("landmarks.model", message, photo=photo.name)
    with FaceDetector(Path(given)) as detector:
        faces = detector.faces(_counted(photo))
    if not faces:
        message = f"{photo.name}: no face is seen in it"
        raise InputError("photo.no_face", message, photo=photo.name)
    if len(faces) > 1:
        boxes = [[round(edge) for edge in face.box] for face in faces]
        message = (
            f"{photo.name}: {len(faces)} faces are seen, at {boxes} (left, top, right, bottom): "
            "cut the picture, or cover the others by a mask"
        )
        raise InputError("photo.faces", message, photo=photo.name, boxes=boxes)
    _check(photo, faces[0], limits)
    points = faces[0].points[:SKIN_POINTS]
    return replace(photo, landmarks={str(number): each for number, each in enumerate(points)})


def _counted(photo: Photo) -> np.ndarray:
    """Return the pixels that count (h, w, 3); what a mask covers is grey."""
    if photo.mask is None:
        return photo.pixels
    return np.where(photo.mask[..., None], photo.pixels, np.float32(0.5))


def _check(photo: Photo, face: DetectedFace, limits: FaceLimits) -> None:
    right, left = face.points[list(EYE_CORNERS)]
    apart = float(np.linalg.norm(left - right) / max(np.cos(face.yaw), 0.2))
    if apart < limits.least_px:
        message = (
            f"{photo.name}: the outer corners of the eyes are {apart:.0f} px apart: at least "
            f"{limits.least_px:.0f} are needed"
        )
        raise InputError("photo.small_face", message, photo=photo.name, found=round(apart))
    yaw = float(np.degrees(face.yaw))
    if yaw > limits.most_yaw_deg:
        message = (
            f"{photo.name}: the head is turned by {yaw:.0f} degrees: beyond "
            f"{limits.most_yaw_deg:.0f} half of the landmarks are hidden"
        )
        raise InputError("photo.profile", message, photo=photo.name, found=round(yaw))
