"""How deep lips and teeth lie inside each other, in a scan or in a fit."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.overlap import between_lips
from solver.errors import InputError
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Crossing:
    """Depths in mm, zero where nothing crosses: the least motion that would undo it.

    lips
        Of a lip's vertex in the other lip; ``vertex`` is that skin vertex, None if none crosses.
    upper_teeth, lower_teeth
        Of a lip's vertex in teeth; None in models without them.
    bite
        Of lower teeth in the upper ones; None without teeth.
    """

    lips: float
    vertex: int | None
    upper_teeth: float | None
    lower_teeth: float | None
    bite: float | None


def crossing(mouth: Mouth, skin: Floats) -> Crossing:
    """Measure the skin (V, 3) of the scan topology: :meth:`Face.whole_skin`, or a scan.

    Raises :class:`InputError` (``scan.nan``) where a vertex of the mouth is not finite.
    """
    points = np.ascontiguousarray(skin[mouth.skin])
    wrong = mouth.skin[~np.isfinite(points).all(axis=1)]
    if len(wrong):
        message = f"vertex {wrong[0]} of the mouth is not finite"
        raise InputError("scan.nan", message, vertex=int(wrong[0]))
    return crossing_at(mouth, points)


def crossing_at(mouth: Mouth, points: Floats) -> Crossing:
    """Measure the positions (m, 3) of a mouth: :meth:`Mouth.points`, all finite."""
    lips = between_lips(mouth, points)
    deepest = int(mouth.skin[lips.ids[lips.depth.argmax()]]) if len(lips.ids) else None
    return Crossing(
        float(lips.depth.max(initial=0.0)),
        deepest,
        _in_teeth(mouth, points, LIPS, UPPER_TEETH),
        _in_teeth(mouth, points, LIPS, LOWER_TEETH),
        _in_teeth(mouth, points, LOWER_TEETH, UPPER_TEETH),
    )


def _in_teeth(mouth: Mouth, points: Floats, part: int, teeth: int) -> float | None:
    """Return how deep a vertex of a part lies in teeth, closed surfaces; None without either."""
    faces: Ints = mouth.faces_of(teeth)
    vertices = points[mouth.label == part]
    if not (len(faces) and len(vertices)):
        return None
    distance, *_ = igl.signed_distance(
        np.ascontiguousarray(vertices),
        points,
        faces,
        igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )
    return float(np.maximum(-np.asarray(distance), 0.0).max(initial=0.0))
