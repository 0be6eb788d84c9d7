"""Depths of lips and teeth inside each other, in a scan or in a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.one_sided import OneSided
from solver.contact.overlap import INSIDE, between_lips
from solver.contact.potentials import arches
from solver.errors import InputError
from solver.mechanics.jaw import move
from solver.mechanics.potential import Boundary
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface


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
        np.ascontiguousarray(vertices), points, faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )
    return float(np.maximum(-np.asarray(distance), 0.0).max(initial=0.0))


# How deep a face in motion lies in what it touches: the figure that contact is judged by.


@dataclass(frozen=True)
class Penetration:
    """Depths in mm, and how many of the lips' vertices are behind teeth.

    ``lips`` is a lip's depth in the other lip, ``teeth`` a lip's in teeth, ``objects`` that of skin
    in objects or of objects in the flesh; zero where nothing crosses, or there is nothing to cross.
    """

    lips: float
    teeth: float
    objects: float
    behind_teeth: int

    @property
    def most(self) -> float:
        """Return the greatest depth."""
        return max(self.lips, self.teeth, self.objects)


class Gauge:
    """Measures the penetration of one model's flesh, frame by frame.

    ``unedited`` is the person before edits, the model itself by default: lips are behind teeth
    where they lie deeper in them, by ``behind_mm``, than that person's do at rest.
    """

    def __init__(
        self, model: SubjectModel, unedited: SubjectModel | None = None, behind_mm: float = 0.2
    ) -> None:
        self._behind_mm = behind_mm
        self._model = model
        self._unedited = unedited or model
        self._mouth = Mouth.of(self._unedited)
        self._arches: list[OneSided] = []
        if self._mouth is not None:
            self._arches = arches(model, self._mouth, 1.0)
        faces = model.skin.faces
        on_flesh = faces[np.isin(faces, model.embedded).all(axis=1)]
        self._faces: Ints = np.searchsorted(model.embedded, on_flesh)

    def neutral(self) -> Penetration:
        """Measure the unedited person at rest: scans of closed lips cross themselves."""
        gauge = self if self._unedited is self._model else Gauge(self._unedited)
        return gauge.at(self._unedited.rest, np.zeros(5))

    def at(self, x: Floats, jaw: Floats, objects: Sequence[Surface] = ()) -> Penetration:
        """Measure vertices x (p, 3), the jaw at b (5,), and objects in the head's frame."""
        lips = teeth = 0.0
        if self._mouth is not None:
            found = crossing_at(self._mouth, self._mouth_points(self._mouth, x, jaw))
            lips = found.lips
            teeth = max(found.upper_teeth or 0.0, found.lower_teeth or 0.0)
        placed = Boundary(np.empty((0, 3)), jaw)
        behind = 0
        for arch in self._arches:
            arch.place(placed)
            behind += len(arch.behind(x, self._behind_mm))
        skin = np.asarray(self._model.embedding @ x + self._model.offset)
        own = Surface(skin, self._faces)
        pairs = [pair for each in objects for pair in ((skin, each), (each.vertices, own))]
        depths = [depth_inside(points, surface) for points, surface in pairs]
        return Penetration(lips, teeth, max(depths, default=0.0), behind)

    def _mouth_points(self, mouth: Mouth, x: Floats, b: Floats) -> Floats:
        """Return the positions (m, 3) of the mouth, teeth where edits and the jaw put them.

        An edit bends the mandible, whose vertices then say no more where its teeth are.
        """
        model = self._model
        points = model.skin.vertices[mouth.skin]
        on_flesh = np.isin(mouth.skin, model.embedded)
        on_jaw = np.isin(mouth.skin, model.attached_mandible)
        points[on_flesh] = mouth.points(x)[on_flesh]
        points[on_jaw] = move(model.jaw, points[on_jaw], b)
        return points


def is_inside(points: Floats, surface: Surface) -> NDArray[np.bool_]:
    """Tell which of points (k, 3) lie inside a surface.

    One with holes, such as a face, has an inside by its generalised winding number (Jacobson et al.
    2013).
    """
    places = np.ascontiguousarray(points)
    winding = igl.fast_winding_number(surface.vertices, surface.faces, places)
    return np.asarray(np.asarray(winding) > INSIDE)


def depth_inside(points: Floats, surface: Surface) -> float:
    """Return how deep the deepest of points (k, 3) lies inside a surface, 0 if none does."""
    inside = np.ascontiguousarray(points[is_inside(points, surface)])
    if not len(inside):
        return 0.0
    squared, *_ = igl.point_mesh_squared_distance(inside, surface.vertices, surface.faces)
    return float(np.sqrt(np.max(squared)))
