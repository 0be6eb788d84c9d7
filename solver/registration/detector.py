"""MediaPipe's face landmarker (optional extra), which runs offline: faces in pictures.

Of each face it tells where 478 points of a mesh are: 468 of the skin, five about each iris. Number
33 is the outer corner of the subject's right eye, 263 that of the left.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.landmarker import HELP
from solver.surface import Floats

SKIN_POINTS = 468  # the first ones; those after them are on the irises
# closed lines of the mesh by the names that curves of photographs have: left is the subject's
LINES = {
    name: tuple(numbers.split())
    for name, numbers in {
        "lips_outer": "61 146 91 181 84 17 314 405 321 375 291 409 270 269 267 0 37 39 40 185",
        "lips_inner": "78 95 88 178 87 14 317 402 318 324 308 415 310 311 312 13 82 81 80 191",
        "eye_left": "263 249 390 373 374 380 381 382 362 398 384 385 386 387 388 466",
        "eye_right": "33 7 163 144 145 153 154 155 133 173 157 158 159 160 161 246",
    }.items()
}
# outline of both lips, from the subject's right corner of the mouth over the lower lip
LIP_OUTLINE = (
    *(61, 146, 91, 181, 84, 17, 314, 405, 321, 375),
    *(291, 409, 270, 269, 267, 0, 37, 39, 40, 185),
)
EYE_CORNERS = 33, 263  # the outer ones, of the subject's right eye and left


@dataclass(frozen=True)
class DetectorOptions:
    """What counts as a face."""

    most_faces: int = 8  # that are looked for in a picture
    confidence: float = 0.5  # least of a face, 0 to 1
    weights: bool = False  # whether those of shapes are told, in a millisecond more


@dataclass(frozen=True)
class DetectedFace:
    """One face of a picture."""

    points: Floats  # (478, 2) px
    # (3, 3) of the face's axes (x to the subject's left, y up, z forward) into the camera's (x
    # right, y up, z backward): the identity where it looks into the camera
    rotation: Floats
    weights: Mapping[str, float] = field(default_factory=dict)  # of ARKit's shapes, if asked for

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Return left, top, right and bottom, px, of the face from brow to chin."""
        low = self.points.min(axis=0)
        high = self.points.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def eyes_px(self) -> float:
        """Return the distance between the outer corners of the eyes, px."""
        right, left = self.points[list(EYE_CORNERS)]
        return float(np.linalg.norm(left - right))

    @property
    def yaw(self) -> float:
        """Return how far the face is turned aside from the camera, rad, to either side.

        Of 30 degrees the detector tells 25, of 60 degrees 47 to 51; beyond 70 it sees no face.
        """
        right, _, towards = self.rotation[:, 2]
        return float(np.arctan2(abs(right), towards))


class FaceDetector:
    """The landmarker of a file ``face_landmarker*.task``; it is closed as a context.

    Raises :class:`InputError`: ``landmarks.extra`` if MediaPipe is not installed,
    ``landmarks.model`` if the file is missing or no such model.
    """

    def __init__(self, model: Path, options: DetectorOptions | None = None) -> None:
        given = options or DetectorOptions()
        if importlib.util.find_spec("mediapipe") is None:
            message = "finding landmarks needs the extra: pip install 'myoface[mediapipe]'"
            raise InputError("landmarks.extra", message)
        if not model.is_file():
            message = f"there is no face landmarker file {model}: {HELP}"
            raise InputError("landmarks.model", message, file=str(model))
        from mediapipe.tasks.python import BaseOptions, vision

        base = BaseOptions(model_asset_buffer=model.read_bytes())
        try:
            wanted = vision.FaceLandmarkerOptions(
                base_options=base,
                num_faces=given.most_faces,
                min_face_detection_confidence=given.confidence,
                min_face_presence_confidence=given.confidence,
                output_facial_transformation_matrixes=True,
                output_face_blendshapes=given.weights,
            )
            self._landmarker: Any = vision.FaceLandmarker.create_from_options(wanted)
        except (RuntimeError, ValueError) as error:
            message = f"{model.name} is no face landmarker ({error}): {HELP}"
            raise InputError("landmarks.model", message, file=str(model)) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._landmarker.close()

    def faces(self, picture: NDArray[np.floating]) -> list[DetectedFace]:
        """Return the faces in a picture (h, w, 3), sRGB from 0 to 1; none where none is seen."""
        return self.faces_in(np.ascontiguousarray(picture * 255 + 0.5, np.uint8))

    def faces_in(self, pixels: NDArray[np.uint8]) -> list[DetectedFace]:
        """Return the same of a picture in bytes."""
        import mediapipe

        image = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=pixels)
        seen = self._landmarker.detect(image)
        height, width = pixels.shape[:2]
        motions = seen.facial_transformation_matrixes
        shapes = seen.face_blendshapes or [()] * len(motions)
        return [
            DetectedFace(
                np.array([(width * point.x, height * point.y) for point in points]),
                np.array(motion)[:3, :3],
                {each.category_name: float(each.score) for each in weights},
            )
            for points, motion, weights in zip(seen.face_landmarks, motions, shapes, strict=True)
        ]
