"""Find the landmarks of the one face that a photograph is to be fitted by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import Finding, InputError, make_warning
from solver.photo.photo import Photo
from solver.registration.detector import DetectedFace, FaceDetector
from solver.surface import Floats

Box = tuple[float, float, float, float]  # left, top, right and bottom, px
TURNED = "the face is turned aside, so that half of it is hidden or nearly so"


@dataclass(frozen=True)
class FaceLimits:
    """Options of finding a face: the scales looked at, and what counts as a face."""

    # parts of the picture, by their sides, in which faces are looked for, and then, where none is
    # seen, more: of what it is shown the detector sees no face whose eyes are closer than a twelfth
    tiles: tuple[tuple[float, ...], ...] = ((1.0, 0.5), (0.25,))
    margin: float = 1.0  # around a box when it is looked at alone, of its size
    bystander: float = 0.4  # of the largest face's size: smaller ones do not count
    # between the outer corners of the eyes, of a face seen from the front: warned below the first,
    # refused below the second
    eyes_px: tuple[float, float] = (60.0, 30.0)
    # of a face to the side as the detector has it, which tells about 50 of 60 degrees
    turned_deg: tuple[float, float] = (38.0, 50.0)
    given_turned_deg: float = 45.0  # the same of given landmarks, which are true to the face
    outside: tuple[float, float] = (0.05, 0.4)  # share of landmarks that the picture does not have


FACE_LIMITS = FaceLimits()


@dataclass(frozen=True)
class PhotoFace:
    """The face of a photograph."""

    landmarks: dict[str, Floats]  # "0" to "477" -> (2,) px, those that the picture shows
    box: Box
    findings: tuple[Finding, ...]  # warnings


def find_face(
    photo: Photo, detector: FaceDetector, box: Box | None = None, limits: FaceLimits = FACE_LIMITS
) -> PhotoFace:
    """Return the landmarks of the only face, or of that in a ``box``, in a photograph.

    Landmarks where the photograph does not count are left out. Raises :class:`InputError` with
    the ``file``: ``photo.no_face``; ``photo.faces``, with the ``boxes`` of all, where there are
    several and no box; ``photo.mask_empty`` where a mask hides it; ``photo.small``,
    ``photo.profile`` and ``photo.cut_off``, whose milder cases are the warnings.
    """
    faces = detect(photo.pixels, detector, box, limits)
    if not faces:
        where = "" if box is None else " in the box"
        message = f"{photo.name}: no face is seen{where}"
        raise InputError("photo.no_face", message, file=photo.name)
    if len(faces) > 1:
        boxes = [[round(side) for side in face.box] for face in faces]
        message = (
            f"{photo.name}: {len(faces)} faces are seen, and no box says which it is; they are at "
            f"{', '.join(map(str, boxes))}"
        )
        raise InputError("photo.faces", message, file=photo.name, boxes=boxes)
    face = faces[0]
    shown = _shown(photo, faces[0].points)
    findings = tuple(_judge(photo, face, limits))
    if not shown.any():
        message = f"{photo.name}: the mask hides all of the face: white is what counts"
        raise InputError("photo.mask_empty", message, file=photo.name)
    landmarks = {str(row): face.points[row] for row in np.flatnonzero(shown)}
    return PhotoFace(landmarks, face.box, findings)


def detect(
    pixels: NDArray[np.floating],
    detector: FaceDetector,
    box: Box | None = None,
    limits: FaceLimits = FACE_LIMITS,
) -> list[DetectedFace]:
    """Return the faces in a picture (h, w, 3), sRGB from 0 to 1, the largest first.

    Bystanders are left out. With a ``box`` the face whose middle is in it, and nearest to its
    middle, is all that is returned.
    """
    if box is not None:
        face = _detect_at(pixels, detector, box, limits)
        return [] if face is None else [face]
    for sides in limits.tiles:
        found: list[DetectedFace] = []
        for tile in _tiles(pixels.shape[1], pixels.shape[0], sides):
            for rough in _detect_in(pixels, detector, tile):
                # landmarks of what is small in a picture lie up to a quarter of the face off
                face = _detect_at(pixels, detector, rough.box, limits) or rough
                if not any(_is_in(_middle(face.box), other.box) for other in found):
                    found.append(face)
        if found:
            largest = max(face.eyes_px for face in found)
            known = [face for face in found if face.eyes_px >= limits.bystander * largest]
            return sorted(known, key=lambda face: -face.eyes_px)
    return []


def _detect_at(
    pixels: NDArray[np.floating], detector: FaceDetector, box: Box, limits: FaceLimits
) -> DetectedFace | None:
    """Return the face at a box, seen with a margin around it."""
    faces = _detect_in(pixels, detector, _with_margin(box, limits.margin))
    within = [face for face in faces if _is_in(_middle(face.box), box)]
    away = [float(np.linalg.norm(_middle(face.box) - _middle(box))) for face in within]
    return within[int(np.argmin(away))] if within else None


def _detect_in(
    pixels: NDArray[np.floating], detector: FaceDetector, box: Box
) -> list[DetectedFace]:
    """Return the faces in a part of a picture, in the picture's pixels."""
    height, width = pixels.shape[:2]
    left, top = (max(0, int(edge)) for edge in box[:2])
    right = min(width, int(np.ceil(box[2])))
    bottom = min(height, int(np.ceil(box[3])))
    if right <= left or bottom <= top:
        return []
    found = detector.faces(pixels[top:bottom, left:right])
    return [replace(face, points=face.points + np.array([left, top])) for face in found]


def _tiles(width: int, height: int, sides: tuple[float, ...]) -> Iterator[Box]:
    """Yield parts of a picture of each of ``sides`` times its size, half over one another."""
    for side in sides:
        steps = np.arange(0.0, 1.0 - side / 2, side / 2)
        for top in steps * height:
            for left in steps * width:
                right = left + side * width
                bottom = top + side * height
                yield float(left), float(top), float(right), float(bottom)


def _with_margin(box: Box, margin: float) -> Box:
    left, top, right, bottom = box
    across = margin * (right - left)
    down = margin * (bottom - top)
    return left - across, top - down, right + across, bottom + down


def _middle(box: Box) -> Floats:
    return np.array([box[0] + box[2], box[1] + box[3]]) / 2


def _is_in(point: Floats, box: Box) -> bool:
    return bool(box[0] <= point[0] <= box[2] and box[1] <= point[1] <= box[3])


def _shown(photo: Photo, points: Floats) -> NDArray[np.bool_]:
    """Return which of the points (n, 2) the photograph shows and counts."""
    width, height = photo.size
    inside = (points >= 0.0) & (points < (width, height))
    shown: NDArray[np.bool_] = np.asarray(inside.all(axis=1))
    if photo.mask is not None:
        column, row = points[shown].astype(np.int64).T
        shown[shown] = photo.mask[row, column]
    return shown


def _judge(photo: Photo, face: DetectedFace, limits: FaceLimits) -> Iterator[Finding]:
    """Yield warnings about a face; raise where it is of no use."""
    turned = float(np.degrees(face.yaw))
    outside = 1.0 - float(_shown(replace(photo, mask=None), face.points).mean())
    turn = limits.turned_deg
    cut = limits.outside
    about = {"box": [round(side) for side in face.box]}
    yield from judge_size(photo.name, face.eyes_px, face.yaw, limits, **about)
    cases = (
        ("photo.profile", (turned > turn[0], turned > turn[1]), TURNED),
        (
            "photo.cut_off",
            (outside > cut[0], outside > cut[1]),
            f"{100 * outside:.0f} % of the face are outside the picture",
        ),
    )
    for code, marks, what in cases:
        yield from _grade(code, marks, f"{photo.name}: {what}", file=photo.name, **about)


def judge_size(
    name: str, eyes_px: float, yaw: float, limits: FaceLimits = FACE_LIMITS, **about: Any
) -> Iterator[Finding]:
    """Yield the warning ``photo.small`` about the face of a photograph ``name``; or raise it.

    ``eyes_px`` lie between the outer corners of the eyes of a face that is turned aside by ``yaw``,
    rad: what counts is how many they were from the front. ``about`` is told beside the name.
    """
    eyes, (wanted, needed) = eyes_px / max(float(np.cos(yaw)), 1e-6), limits.eyes_px
    message = (
        f"{name}: the face is small: {eyes:.0f} px between the outer corners of the eyes, where "
        f"{wanted:.0f} are wanted and {needed:.0f} needed"
    )
    yield from _grade("photo.small", (eyes < wanted, eyes < needed), message, file=name, **about)


def judge_turn(name: str, yaw: float, limits: FaceLimits = FACE_LIMITS) -> Iterator[Finding]:
    """Yield the warning ``photo.profile`` about a photograph whose landmarks are given.

    The face is turned aside by ``yaw``, rad. It is not refused: of a profile in a moment of several
    photographs its landmarks are worth as much as those of the others.
    """
    turned = float(np.degrees(yaw))
    if turned > limits.given_turned_deg:
        message = f"{name}: {TURNED}, by {turned:.0f} degrees"
        yield make_warning("photo.profile", message, {"file": name})


def _grade(code: str, marks: tuple[bool, bool], message: str, **about: Any) -> Iterator[Finding]:
    """Yield a warning if it is to be warned (the first mark); raise it if refused (the second)."""
    is_warned, is_refused = marks
    if is_refused:
        raise InputError(code, message, **about)
    if is_warned:
        yield make_warning(code, message, about)
