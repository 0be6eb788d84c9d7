"""What a person or a program knows of a photograph: its camera, landmarks and curves, from JSON.

Everything is checked against the picture that it is of, and all that is wrong is told at once. The
form of the document is :class:`~solver.kinds.photo.PhotoDocument`.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from solver.anatomy.data import SIDES, read_table
from solver.errors import InputError, quote
from solver.kinds.document import find_faults
from solver.kinds.photo import MEDIAPIPE_POINTS, CameraEntry, CurvesEntry, PhotoDocument
from solver.photo.camera import Lens, PinholeCamera
from solver.photo.picture import FOCAL_PX, Picture
from solver.registration.landmarks import IBUG_68, LEAST_LANDMARKS, MEDIAPIPE, SYNONYMS
from solver.surface import Floats

MOST_BYTES = 1 << 20  # of a file
MOST_FAULTS = 20  # that are told of one

# Points of the 68-point scheme, from 0, -> MediaPipe's number. The jaw's 17 are left out: they are
# where the outline happens to be.
IBUG_MEDIAPIPE: Mapping[int, str] = {
    int(row["point"]): row["landmark"]
    for row in read_table("landmark_schemes")
    if row["scheme"] == "ibug_mediapipe"
}
NUMBERS = tuple(str(number) for number in range(MEDIAPIPE_POINTS[0]))

# Numbers of MediaPipe's mesh on the right and the left: ends of brows, corners of eyes, wings of
# the nose, corners of the mouth; which of them and of others are at the eyes, and which below.
PAIRS = (
    ("70", "300"),
    ("107", "336"),
    ("33", "263"),
    ("133", "362"),
    ("98", "327"),
    ("61", "291"),
    ("eye_right", "eye_left"),
)
UPPER = ("70", "107", "33", "133", "300", "336", "263", "362", "eye_right", "eye_left")
LOWER = ("2", "98", "327", "61", "291", "0", "13", "14", "17", "152", "lips_outer", "lips_inner")
UPPER_NAMES = ("brow_", "exocanthion", "endocanthion", "palpebrale")  # beginnings
LOWER_NAMES = ("alar", "subnasale", "cheilion", "labrale", "stomion", "gnathion", "menton")

LEAST_SPREAD = 8.0  # px; landmarks as shares of a picture are within one
SWAPPED = 0.05  # of the landmarks' extent that one of a pair is on the other's side
PIXEL_SHAPE = (0.4, 2.5)  # fy by fx; anamorphic lenses have 2
ROUNDING = 1e-3  # off which a rotation may be orthogonal
FAR_OUTSIDE = 1.0  # of a picture's size that a principal point may be off it: crops have such
GRID = 24  # points along a picture's side where a distortion is tried
ROUNDS = 100  # of taking a distortion out; strong ones need most
OFF_PX = 0.05  # that a distortion may bring back a pixel
# A curve crosses itself if it cuts off a loop as wide as this: lips that meet and lids that are
# shut are traced to and fro along one line.
LOOP_PX = 1.5  # the least width ...
LOOP_SHARE = 0.02  # ... and the same by the curve's extent
MOST_CROSSINGS = 200  # of a curve that are looked at


@dataclass(frozen=True)
class Facts:
    """Facts of a picture; places are in it as it is, distorted."""

    camera: PinholeCamera | None = None
    lens: Lens | None = None  # None: the camera does not distort
    landmarks: Mapping[str, Floats] = field(default_factory=dict)
    curves: Mapping[str, Floats] = field(default_factory=dict)
    is_placed: bool = False  # whether the camera's place in the world is known


class _Fault(NamedTuple):
    code: str
    where: str
    message: str


def read_facts(path: Path, picture: Picture, names: Collection[str] = ()) -> Facts:
    """Read the JSON beside a picture; ``names`` are landmarks of a template of one's own.

    Raises :class:`InputError` with ``file``, and of a document with ``where`` (the first fault's
    place) and ``faults`` (the first twenty: ``code``, ``where``, ``message``):
    ``photo.facts_unreadable`` (no JSON, or too large), ``photo.facts_schema`` (a value is not
    allowed), ``photo.size`` (the places are of a picture of another size), ``photo.camera``,
    ``photo.landmarks_unknown``, ``photo.landmarks_few``, ``photo.landmarks_outside``,
    ``photo.swapped`` (left and right are exchanged), ``photo.curve`` (it crosses itself or is
    outside).
    """
    document = _load(path)
    try:
        read = PhotoDocument.model_validate(document)
    except ValidationError as error:
        found = find_faults(error, document, "photo")
        raise _error(
            path.name, [_Fault("photo.facts_schema", each.where, each.message) for each in found]
        ) from error
    width, height = picture.size
    if read.size is not None and tuple(read.size) != picture.size:
        given = f"{read.size[0]} x {read.size[1]}"
        message = f"the places are of a picture of {given} px, the file has {width} x {height}"
        if picture.is_turned and tuple(read.size) == picture.size[::-1]:
            message += " once it is turned upright as its EXIF says: take the places in that"
        raise _error(path.name, [_Fault("photo.size", "photo.size", message)])
    landmarks, unknown = _read_landmarks(read.landmarks, names)
    curves = _arrays(read.curves)
    faults = [
        *unknown,
        *_camera_faults(read.camera, picture.size),
        *_landmark_faults(landmarks, picture.size, is_given=read.landmarks is not None),
        *_curve_faults(curves, picture.size),
    ]
    faults = faults or [*_side_faults(landmarks, curves)]
    if faults:
        raise _error(path.name, faults)
    places = {name: place for name, (place, _) in landmarks.items()}
    is_placed = read.camera is not None and read.camera.rotation is not None
    return Facts(*_camera(read.camera, picture.size), places, curves, is_placed)


def _load(path: Path) -> Any:
    try:
        with path.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES} bytes")
        return json.loads(content)
    except (OSError, RecursionError, ValueError) as error:
        message = f"{path.name} is no JSON with what is known of a photograph: {quote(error)}"
        raise InputError("photo.facts_unreadable", message, file=path.name) from error


def _error(file: str, faults: Sequence[_Fault]) -> InputError:
    """Return one error for all faults; its code and place are the first one's."""
    first = faults[0]
    told = [fault._asdict() for fault in faults[:MOST_FAULTS]]
    more = f", and {len(faults) - 1} more" if len(faults) > 1 else ""
    message = f"{file}: {first.where}: {first.message}{more}"
    return InputError(first.code, message, file=file, where=first.where, faults=told)


# Landmarks: a place and where it stands in the document, by name.

Named = dict[str, tuple[Floats, str]]


def _read_landmarks(
    given: dict[str, list[float]] | list[list[float] | None] | None, names: Collection[str]
) -> tuple[Named, list[_Fault]]:
    """Return landmarks by the names that photographs have, and those that nobody knows."""
    where = "photo.landmarks"
    if isinstance(given, dict):
        known = {*NUMBERS, *_public_names(), *names}
        unknown = [_unknown_fault(name, known, where) for name in given if name not in known]
        return {
            name: (np.array(place), f"{where}.{name}")
            for name, place in given.items()
            if name in known
        }, unknown
    by_row = dict(enumerate(NUMBERS)) if len(given or ()) in MEDIAPIPE_POINTS else IBUG_MEDIAPIPE
    return {
        by_row[row]: (np.array(place), f"{where}[{row}]")
        for row, place in enumerate(given or ())
        if place is not None and row in by_row
    }, []


def _unknown_fault(name: str, known: Collection[str], where: str) -> _Fault:
    close = difflib.get_close_matches(name[:64], known, 3)
    nearest = f"; near it are {', '.join(close)}" if close else ""
    message = f"no template has a landmark {quote(name)!r}{nearest}"
    return _Fault("photo.landmarks_unknown", where, message)


def _public_names() -> set[str]:
    """Return the names of landmarks that templates of ours have, with their sides."""
    own = {row["name"] for table in ("landmarks", "ict_landmarks") for row in read_table(table)}
    own |= {*SYNONYMS, *SYNONYMS.values(), *IBUG_68.values(), *MEDIAPIPE.values()}
    stems = {name.removesuffix(SIDES[0]).removesuffix(SIDES[1]) for name in own}
    return {f"{stem}{side}" for stem in stems for side in ("", *SIDES)}


def _landmark_faults(
    landmarks: Named, size: tuple[int, int], *, is_given: bool
) -> Iterator[_Fault]:
    where = "photo.landmarks"
    few = "photo.landmarks_few"
    if is_given and len(landmarks) < LEAST_LANDMARKS:
        message = f"{len(landmarks)} can be used, at least {LEAST_LANDMARKS} are needed"
        yield _Fault(few, where, message)
    elif (
        is_given and np.ptp([place for place, _ in landmarks.values()], axis=0).max() < LEAST_SPREAD
    ):
        message = (
            f"all are within {LEAST_SPREAD:g} px: places are pixels, not shares of a picture's size"
        )
        yield _Fault(few, where, message)
    for place, spot in landmarks.values():
        if _is_outside(place, size):
            yield _Fault("photo.landmarks_outside", spot, _outside(place, size))


def _is_outside(places: Floats, size: tuple[int, int]) -> bool:
    return bool(((places < 0.0) | (places > np.array(size))).any())


def _outside(place: Floats, size: tuple[int, int]) -> str:
    column, row = place
    return f"({column:g}, {row:g}) is outside the picture, which has {size[0]} x {size[1]} px"


def _side_faults(landmarks: Named, curves: Mapping[str, Floats]) -> Iterator[_Fault]:
    """Tell left and right that are exchanged, of all landmarks and curves or of one pair.

    From a person's right to the left, and from the eyes to the mouth, is clockwise in a picture
    that is no mirror's, whichever way the head is turned and as long as the eyes are seen.
    """
    spots = {name: spot for name, (_, spot) in landmarks.items()}
    places = {name: place for name, (place, _) in landmarks.items()}
    for name, curve in curves.items():
        places[name] = curve.mean(axis=0)
        spots[name] = f"photo.curves.{name}"
    pairs = [*PAIRS, *((name, f"{name[:-2]}_l") for name in places if name.endswith("_r"))]
    across = {
        pair: places[pair[1]] - places[pair[0]]
        for pair in pairs
        if pair[0] in places and pair[1] in places
    }
    upper = [
        place for name, place in places.items() if name in UPPER or name.startswith(UPPER_NAMES)
    ]
    lower = [
        place for name, place in places.items() if name in LOWER or name.startswith(LOWER_NAMES)
    ]
    if not across or not upper or not lower:
        return
    down = np.mean(lower, axis=0) - np.mean(upper, axis=0)
    # to the subject's left in a picture that is no mirror's, of length 1
    left = np.array([down[1], -down[0]]) / max(float(np.linalg.norm(down)), 1e-12)
    extent = float(np.ptp(list(places.values()), axis=0).max())
    swapped = [pair for pair, way in across.items() if way @ left < -SWAPPED * extent]
    kept = [pair for pair, way in across.items() if way @ left > SWAPPED * extent]
    if swapped and not kept:
        message = (
            "left and right are exchanged, or the picture is a mirror's: left is the subject's, "
            "which is on the right of a picture from the front"
        )
        yield _Fault("photo.swapped", "photo", message)
    elif swapped:
        for right, other in swapped:
            message = f"{right} and {other} are exchanged: left is the subject's"
            yield _Fault("photo.swapped", spots[right], message)


# Curves.


def _arrays(curves: CurvesEntry) -> dict[str, Floats]:
    given = ((name, getattr(curves, name)) for name in CurvesEntry.model_fields)
    return {name: np.array(points) for name, points in given if points is not None}


def _curve_faults(curves: Mapping[str, Floats], size: tuple[int, int]) -> Iterator[_Fault]:
    for name, curve in curves.items():
        where = f"photo.curves.{name}"
        if _is_outside(curve, size):
            row = int(np.argmax(((curve < 0.0) | (curve > np.array(size))).any(axis=1)))
            yield _Fault("photo.curve", f"{where}[{row}]", _outside(curve[row], size))
        elif np.ptp(curve, axis=0).max() < LEAST_SPREAD:
            yield _Fault("photo.curve", where, f"all points are within {LEAST_SPREAD:g} px")
        elif (place := _crossing(curve)) is not None:
            message = f"it crosses itself after point {place}: put the points in order"
            yield _Fault("photo.curve", f"{where}[{place}]", message)


def _crossing(curve: Floats) -> int | None:
    """Return a segment (the number of its first point) where a curve crosses itself, if any."""
    starts = curve[:-1]
    ends = curve[1:]
    # whether both ends of segment j are on different sides of segment i
    apart = _sides(starts, ends, starts) * _sides(starts, ends, ends) < 0.0
    first, second = np.nonzero(np.triu(apart & apart.T, k=2))
    if len(first) > MOST_CROSSINGS:
        return int(first[0])
    is_closed = bool((curve[0] == curve[-1]).all())
    wide = max(LOOP_PX, LOOP_SHARE * float(np.ptp(curve, axis=0).max()))
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        at = _meeting(starts[i], ends[i], starts[j], ends[j])
        loops = [np.vstack([at, curve[i + 1 : j + 1]])]
        if is_closed:
            loops.append(np.vstack([at, curve[j + 1 :], curve[1 : i + 1]]))
        if min(map(_width, loops)) > wide:
            return int(i)
    return None


def _sides(starts: Floats, ends: Floats, points: Floats) -> Floats:
    """Return on which side of segments (n, 2) points (k, 2) lie: (n, k), by sign."""
    along = (ends - starts)[:, None]
    away = points[None] - starts[:, None]
    return np.asarray(along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0])


def _meeting(start: Floats, end: Floats, other_start: Floats, other_end: Floats) -> Floats:
    """Return where two segments that cross meet (2,)."""
    along = end - start
    other = other_end - other_start
    away = other_start - start
    determinant = along[0] * other[1] - along[1] * other[0]
    return np.asarray(start + along * ((away[0] * other[1] - away[1] * other[0]) / determinant))


def _width(loop: Floats) -> float:
    """Return twice a loop's area by half its length, px: of a narrow one, how wide it is."""
    after = np.roll(loop, -1, axis=0)
    area = abs(float(np.sum(loop[:, 0] * after[:, 1] - loop[:, 1] * after[:, 0]))) / 2.0
    return 2.0 * area / max(float(np.linalg.norm(after - loop, axis=1).sum()), 1e-12)


# The camera.


def _camera(
    entry: CameraEntry | None, size: tuple[int, int]
) -> tuple[PinholeCamera | None, Lens | None]:
    if entry is None:
        return None, None
    focal = np.array([entry.fx, entry.fy])
    centre = _centre(entry, size)
    distortion = np.array(entry.distortion)
    rotation = np.eye(3)
    translation = np.zeros(3)
    if entry.rotation is not None:  # rounded, as files have it
        rotation = Rotation.from_matrix(np.array(entry.rotation)).as_matrix()
        translation = np.array(entry.translation)
    lens = Lens(focal, centre, distortion) if distortion.any() else None
    return PinholeCamera(focal, centre, rotation, translation), lens


def _centre(entry: CameraEntry, size: tuple[int, int]) -> Floats:
    given = (entry.cx, entry.cy)
    middles = (size[0] / 2.0, size[1] / 2.0)
    return np.array([m if c is None else c for c, m in zip(given, middles, strict=True)])


def _camera_faults(entry: CameraEntry | None, size: tuple[int, int]) -> Iterable[_Fault]:
    """Tell what no camera has that took a picture of this size."""
    if entry is None:
        return
    code = "photo.camera"
    where = "photo.camera"
    least, most = (bound * max(size) for bound in FOCAL_PX)
    for name, focal in (("fx", entry.fx), ("fy", entry.fy)):
        if not least <= focal <= most:
            message = (
                f"{focal:g} px is no focal length of a picture of {size[0]} x {size[1]} px: "
                f"{least:.0f} to {most:.0f} are (mm times a picture's pixels by the sensor's mm)"
            )
            yield _Fault(code, f"{where}.{name}", message)
            return
    narrow, broad = PIXEL_SHAPE
    if not narrow <= entry.fy / entry.fx <= broad:
        message = f"it is {entry.fy / entry.fx:.3g} of fx: pixels are no such rectangles"
        yield _Fault(code, f"{where}.fy", message)
    for name, place, side in zip(("cx", "cy"), _centre(entry, size), size, strict=True):
        if not -FAR_OUTSIDE * side <= place <= (1.0 + FAR_OUTSIDE) * side:
            message = f"{place:g} px is far outside the picture, which has {side}"
            yield _Fault(code, f"{where}.{name}", message)
    if entry.rotation is not None:
        rotation = np.array(entry.rotation)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROUNDING:
            yield _Fault(code, f"{where}.rotation", "is no rotation: its rows are not orthonormal")
        elif np.linalg.det(rotation) < 0:
            yield _Fault(code, f"{where}.rotation", "is no rotation: it mirrors")
    if any(entry.distortion) and _folds(entry, size):
        message = "folds the picture: no pinhole's pixel is where it has some of its own"
        yield _Fault(code, f"{where}.distortion", message)


def _folds(entry: CameraEntry, size: tuple[int, int]) -> bool:
    """Return whether some of a picture's pixels are nowhere without distortion, or in two places.

    A distortion is one to one as far as its Jacobian's determinant is positive on the way out.
    """
    lens = Lens(np.array([entry.fx, entry.fy]), _centre(entry, size), np.array(entry.distortion))
    sides = [np.linspace(0.0, side, GRID) for side in size]
    pixels = np.column_stack([axis.ravel() for axis in np.meshgrid(*sides)])
    with np.errstate(all="ignore"):
        found = lens.undistort(pixels, ROUNDS)
        off = np.linalg.norm(lens.distort(found) - pixels, axis=1).max()
        if not off < OFF_PX:
            return True
        ways = np.linspace(1.0 / GRID, 1.0, GRID)[:, None, None]
        inner = (lens.centre + ways * (found - lens.centre)).reshape(-1, 2)
        step = 1e-3 * math.hypot(*size) / GRID
        steps = step * np.eye(2)
        across, down = (lens.distort(inner + way) - lens.distort(inner - way) for way in steps)
        determinant = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
        return not bool((determinant > 0.0).all())
