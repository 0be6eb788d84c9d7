"""Landmarks of a raw scan: from a file, or found on pictures of it.

Landmarks carry a template's names (``sellion``, ``cheilion_l``; ``_l`` is the subject's left). The
68 points of the iBUG scheme (Sagonas et al. 2013) and MediaPipe's face mesh are named by tables.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.data import read_table
from solver.anatomy.template import Template
from solver.drawing.render import Camera, DrawnBody, Lit, Visible, look, render
from solver.errors import InputError, file_error, quote, quote_names
from solver.registration.detector import DetectorOptions, FaceDetector
from solver.similarity import fit_similarity
from solver.surface import Floats, Ints, Surface

_SCHEMES = read_table("landmark_schemes")
# Point of the 68-point scheme, from 0, and vertex of MediaPipe's face mesh -> name.
IBUG_68, MEDIAPIPE = (
    {int(row["point"]): row["landmark"] for row in _SCHEMES if row["scheme"] == name}
    for name in ("ibug", "mediapipe")
)
# Names of one place in different templates.
SYNONYMS = {"pronasale": "nose_tip", "nasion": "sellion"}
LABELS_68 = (  # in the scheme's order; the first brow and eye are the subject's right
    (("jaw", "chin"), 17),
    (("left_eyebrow", "leyebrow"), 5),
    (("right_eyebrow", "reyebrow"), 5),
    (("nose",), 9),
    (("left_eye", "leye"), 6),
    (("right_eye", "reye"), 6),
    (("mouth",), 20),
)
MIRRORED_MM = 4.0  # of a left landmark's mirror image to its twin
LEAST_LANDMARKS = 4  # that give a pose
MISPLACED_MM = 20.0  # off where a face has it

Points = dict[str, Floats]

_unreadable = partial(file_error, "landmarks.unreadable")


def read_landmarks(path: Path) -> Points:
    """Return name -> point (3,), in the scan's own unit and axes.

    JSON holds an object of name -> [x, y, z] (also under the key ``landmarks``), CSV the columns
    name, x, y, z (a heading is skipped), ``ljson`` 68 points. Raises :class:`InputError`
    (``landmarks.unreadable``, ``landmarks.format``) naming file and line or landmark.
    """
    suffix = path.suffix.lower()
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(path.name, str(error)) from error
    if suffix == ".csv":
        return _csv(path, text)
    if suffix not in (".json", ".ljson"):
        message = f"{path.name}: landmarks are a .json, .ljson or .csv file"
        about = {"file": path.name, "expected": [".json", ".ljson", ".csv"], "found": suffix}
        raise InputError("landmarks.format", message, **about)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _unreadable(path.name, str(error)) from error
    if isinstance(content, dict) and "groups" in content:
        return _ljson(path, content)
    if isinstance(content, dict) and isinstance(content.get("landmarks"), dict):
        content = content["landmarks"]
    if not isinstance(content, dict) or not content:
        raise _unreadable(path.name, "an object of name -> [x, y, z] is expected")
    return {str(name): _point(path, str(name), value) for name, value in content.items()}


def landmark_vertices(template: Template) -> dict[str, int]:
    """Return name -> skin vertex, those of the right side mirrored from the left where missing."""
    found = dict(template.landmarks)
    for name, other in SYNONYMS.items():
        if name in found:
            found.setdefault(other, found[name])
    points = template.skin.vertices[template.face_vertices]
    for name, vertex in list(found.items()):
        twin = name[:-2] + "_r"
        if name.endswith("_l") and twin not in found:
            mirrored = template.skin.vertices[vertex] * np.array([-1.0, 1.0, 1.0])
            distance = np.linalg.norm(points - mirrored, axis=1)
            if distance.min() < MIRRORED_MM:
                found[twin] = int(template.face_vertices[np.argmin(distance)])
    return found


def match(file: str, points: Points, template: Template) -> tuple[Floats, Ints]:
    """Return the points (k, 3) that the template knows, and their vertices (k,).

    Raises :class:`InputError`: ``landmarks.unknown`` if the template knows too few of the names,
    ``landmarks.swapped`` if left and right are exchanged, ``landmarks.misplaced`` if they do not
    lie as on a face, with the worst ``landmark``.
    """
    known = landmark_vertices(template)
    named = {SYNONYMS.get(name, name): point for name, point in points.items()}
    names = sorted(named.keys() & known.keys())
    if len(names) < LEAST_LANDMARKS:
        expected = sorted(known)
        found = quote_names(sorted(points))
        message = (
            f"{file}: the template knows {len(names)} of these landmarks, at least "
            f"{LEAST_LANDMARKS} are needed; it knows {', '.join(expected)}"
        )
        raise InputError("landmarks.unknown", message, file=file, expected=expected, found=found)
    rest = template.skin.vertices
    given = np.array([named[name] for name in names])
    if np.ptp(given, axis=0).max() == 0:
        message = f"{file}: all landmarks lie in one place"
        raise InputError("landmarks.misplaced", message, file=file)
    vertices = np.array([known[name] for name in names])
    sides = {"_l": "_r", "_r": "_l"}
    others = (name[:-2] + sides.get(name[-2:], name[-2:]) for name in names)
    swapped = [known.get(*pair) for pair in zip(others, vertices.tolist(), strict=True)]
    error = _misfit(given, rest[vertices])
    swapped_error = _misfit(given, rest[swapped])
    if swapped_error.mean() < 0.6 * error.mean():
        message = f"{file}: left and right are exchanged; _l means the subject's left"
        raise InputError("landmarks.swapped", message, file=file)
    worst = int(np.argmax(error))
    name = names[worst]
    off = float(error[worst])
    if off > MISPLACED_MM:
        message = f"{file}: {name} lies {off:.0f} mm from where a face has it"
        about = {"file": file, "landmark": name, "found": off, "expected": MISPLACED_MM}
        raise InputError("landmarks.misplaced", message, **about)
    return given, vertices


def _misfit(points: Floats, rest: Floats) -> Floats:
    motion = fit_similarity(points, rest)
    return np.asarray(np.linalg.norm(motion(points) - rest, axis=1))


def _ljson(path: Path, content: Mapping[str, Any]) -> Points:
    try:
        group = next(iter(content["groups"].values())) if content["groups"] else content
        rows = group["landmarks"]["points"]
        masks = {label["label"].lower(): label["mask"] for label in group.get("labels", [])}
        count = len(rows)
        ordered = [masks[name] for names, _ in LABELS_68 for name in names if name in masks]
        if [len(mask) for mask in ordered] == [length for _, length in LABELS_68]:
            rows = [rows[number] for mask in ordered for number in mask]
        points = {name: rows[number] for number, name in IBUG_68.items() if count == 68}
    except (LookupError, TypeError, AttributeError, StopIteration) as error:
        raise _unreadable(path.name, "not an ljson file with landmarks and points") from error
    if count != 68:
        raise _unreadable(path.name, f"{count} points; only the 68-point scheme is known")
    return {name: _point(path, name, point) for name, point in points.items()}


def _csv(path: Path, text: str) -> Points:
    points: Points = {}
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip() for cell in line.split(",")]
        if not any(cells) or (number == 1 and cells[0].lower() in ("name", "landmark")):
            continue
        if len(cells) != 4:
            raise _unreadable(path.name, "four columns are expected: name, x, y, z", line=number)
        name = cells[0]
        if name in points:
            raise _unreadable(path.name, f"{quote(name)} is there twice", line=number)
        points[name] = _point(path, name, cells[1:], line=number)
    if not points:
        raise _unreadable(path.name, "it holds no landmarks")
    return points


def _point(path: Path, name: str, value: Any, **where: Any) -> Floats:
    shown = quote(name)
    try:
        if isinstance(value, str):
            raise TypeError
        x, y, z = (float(number) for number in value)
    except (TypeError, ValueError, OverflowError):
        raise _unreadable(
            path.name, f"{shown} is not three numbers", landmark=shown, **where
        ) from None
    if not all(math.isfinite(number) for number in (x, y, z)):
        raise _unreadable(path.name, f"{shown} is not finite", landmark=shown, **where)
    return np.array([x, y, z])


# Landmarks found by a detector: the scan is drawn from a few sides, and what is seen in the
# pictures is carried back to the surface.

PIXELS = 512  # of a picture's side
YAWS = np.radians([0.0, -25.0, 25.0])  # of the pictures
GREY = (0.5, 0.5, 0.5)  # of the skin
# A landmark counts if two views have it this close together.
AGREE_MM = 6.0


def find_landmarks(scan: Surface, face: Floats, model: Path) -> Points:
    """Return name -> point (3,) of those landmarks that two views agree on.

    ``scan`` has triangles and lies in mm, upright, the face forward; ``face`` (k, 3) are points
    about where the face is, for the camera; ``model`` is the landmarker's file
    ``face_landmarker*.task``. Raises :class:`InputError`: ``landmarks.extra`` if MediaPipe is not
    installed, ``landmarks.model`` if the file is missing or no such model.
    """
    low = face.min(axis=0)
    high = face.max(axis=0)
    body = DrawnBody(Lit(scan), np.broadcast_to(GREY, scan.vertices.shape))
    seen: dict[str, list[Floats]] = {}
    with FaceDetector(model, DetectorOptions(most_faces=1)) as detector:
        for yaw in YAWS:
            camera = Camera((low + high) / 2, span=1.6 * float(high[1] - low[1]), yaw=yaw)
            visible = look(camera, scan, PIXELS, PIXELS)
            for shown in detector.faces(render([body], camera, PIXELS, PIXELS)):
                for number, name in MEDIAPIPE.items():
                    point = _on_surface(scan, visible, *shown.points[number])
                    if point is not None:
                        seen.setdefault(name, []).append(point)
    found = {}
    for name, points in seen.items():
        close = np.linalg.norm(points - np.median(points, axis=0), axis=1) < AGREE_MM
        if close.sum() > 1:
            found[name] = np.array(points)[close].mean(axis=0)
    return found


def _on_surface(scan: Surface, visible: Visible, column: float, row: float) -> Floats | None:
    """Return the point of the surface in a pixel; None where a hole is."""
    x = int(column)
    y = int(row)
    if min(x, y) < 0 or max(x, y) >= PIXELS or visible.triangle[y, x] < 0:
        return None
    corners = scan.vertices[visible.faces[visible.triangle[y, x]]]
    return np.asarray(visible.weights[y, x].astype(float) @ corners)
