"""Binding: a session's marker set by the places of a take's markers on a person.

The face of a take is found on the person (:mod:`.face_take`). Each marker is then bound where it
lies: to the skin with a height over it, or to the bone that it rides on. A check goes the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import igl
import numpy as np

from solver.anatomy.embedding import barycentric
from solver.mechanics.boundary import move_jaw, move_jaw_back
from solver.model import JawFrame, SubjectModel
from solver.registration.search import nose_tip
from solver.scans.markers.places.face_take import FACE, FaceMarkers, LocatedTake
from solver.scans.markers.places.locate import LOCATE, Located, heights_over
from solver.scans.markers.places.marker_set import Marker, MarkerSet, Triple, places_over
from solver.scans.markers.readers.names import PLACES, Named
from solver.similarity import Similarity, robust_motion_of_seen
from solver.surface import Floats, Ints, Surface, area_normals, unit_rows


@dataclass(frozen=True)
class BindOptions:
    """Limits of what a marker is bound to; lengths in mm."""

    # A marker too far from the skin for a face is of the head if it is so far above the nose's tip
    above: float = 45.0
    of_head: float = 260.0  # ... and no farther from it than this
    usual_height: float = 2.0  # of markers over the skin
    farthest: float = 10_000.0  # beyond it nothing is a marker; a set has no room for such places
    sigma: float = 1.0  # of a place by the nearest point of the skin
    bony_sigma: float = 0.5
    slack: float = 3.0  # of a rigid motion onto places: off by more, little weight
    steps: int = 12


BIND = BindOptions()


class Expression(Protocol):
    """A face that is not at rest, as a rig has it."""

    @property
    def skin(self) -> Floats:
        """Return the skin's vertices (V, 3)."""

    @property
    def jaw(self) -> Floats:
        """Return its b (5,)."""


@dataclass(frozen=True)
class Reference:
    """The face that a take shows: nobody's, or a person's, perhaps with markers."""

    face: Surface
    model_sha256: str = ""  # of the person's model; empty for a face that is nobody's
    markers: MarkerSet | None = None
    jaw: tuple[JawFrame, Floats] | None = None  # and its b (5,), if it is not at rest
    rims: Mapping[int, Rim] = field(default_factory=dict)  # of its orbits, by side

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        markers: MarkerSet | None = None,
        expression: Expression | None = None,
    ) -> Reference:
        """Return a person at rest, or in an expression.

        Raises :class:`InputError` as :meth:`MarkerSet.check_model`.
        """
        if markers is not None:
            markers.check_model(model)
        face = model_face(model)
        jaw = None
        if expression is not None:
            face = face.with_vertices(expression.skin)
            jaw = (model.jaw, expression.jaw)
        rims = find_rims(face.vertices, model.regions)
        return cls(face, model.sha256, markers, jaw, rims)

    @classmethod
    def given(
        cls, model: SubjectModel, files: Mapping[str, Path], expression: Expression | None = None
    ) -> Reference:
        """Return a person as :meth:`of`, with the marker set among a job's ``files`` if any.

        Raises :class:`InputError` as :meth:`MarkerSet.load`.
        """
        markers = MarkerSet.load(files["marker_set"], model) if "marker_set" in files else None
        return cls.of(model, markers, expression)

    def places(self, markers: MarkerSet) -> Floats:
        """Return where the markers (k, 3) of a set lie on this face, NaN for those without."""
        places = rest_places(markers, self.face)
        if self.jaw is not None:
            lower, (frame, b) = markers.of_part("lower_teeth"), self.jaw
            places[lower] = move_jaw(frame, places[lower], b)
        return places

    def bind(self, markers: tuple[Marker, ...], session: Similarity) -> MarkerSet:
        """Return the set of markers on this face, those of the mandible where that rests."""
        if self.jaw is not None:
            markers = tuple(_close_jaw(each, *self.jaw) for each in markers)
        return MarkerSet(markers, session, self.model_sha256)


def _close_jaw(marker: Marker, frame: JawFrame, b: Floats) -> Marker:
    if marker.part != "lower_teeth" or marker.place_mm is None:
        return marker
    x, y, z = move_jaw_back(frame, np.array(marker.place_mm), b).tolist()
    return replace(marker, place_mm=(x, y, z))


def model_face(model: SubjectModel) -> Surface:
    """Return the part of a person's skin that markers sit on, in the numbers of the whole skin."""
    is_face = np.zeros(len(model.skin.vertices), bool)
    is_face[model.face] = True
    return Surface(model.skin.vertices, model.skin.faces[is_face[model.skin.faces].all(axis=1)])


def place_take(
    located: LocatedTake, pose: Located, reference: Reference, *, actor: bool = False
) -> tuple[Marker, ...]:
    """Return a marker for every label of a take whose face has a ``pose``.

    An ``actor``'s markers are brought to the person's size by their names, and lie on the skin as
    markers do: their distance from it then is how unlike the two faces are. Markers of the orbit
    lie on its rim.
    """
    session = pose.session
    height = None
    if actor:
        session = pose.similar or session
        height = BIND.usual_height
    placed = session(located.points)
    if actor:
        placed = clear_lids(placed, located.face.names, reference.rims)
    return place_markers(located.face, placed, reference.face, height)


def place_markers(
    face: FaceMarkers, placed: Floats, skin: Surface, height_mm: float | None = None
) -> tuple[Marker, ...]:
    """Return a marker for every label that is ``placed`` (n, 3): on skin, bone, or ignored.

    Markers of the skin get one ``height_mm``; without it each has its own.
    """
    seen = np.flatnonzero((np.abs(placed) < BIND.farthest).all(axis=1))
    heights = heights_over(placed[seen], skin)
    tip = nose_tip(skin)
    found = []
    for row, number in enumerate(seen.tolist()):
        name = face.names[number]
        at = placed[number]
        label = face.labels[number]
        part = "face" if name is None else name.part
        if part == "face" and abs(heights[row]) > LOCATE.off_skin:
            near = np.linalg.norm(at - tip) < BIND.of_head and at[1] - tip[1] > BIND.above
            part = "head" if near else "ignore"
        if part == "face":
            marker = place_on(Marker(label, sigma_mm=BIND.sigma), at, skin)
            height = marker.height_mm if height_mm is None else height_mm
            found.append(replace(marker, height_mm=height))
        else:
            at_bone: Triple = (float(at[0]), float(at[1]), float(at[2]))
            sigma = BIND.bony_sigma
            found.append(Marker(label, part=part, sigma_mm=sigma, place_mm=at_bone))
    return tuple(found)


def place_on(marker: Marker, point: Floats, skin: Surface) -> Marker:
    """Return a marker moved to ``point`` (3,): on the triangle of a ``skin`` that gives it best.

    Over an edge no triangle's normal goes through the point. So those about the nearest one are
    tried, and about the marker's own: to lie at another height than it does, or beside the foot,
    costs as much as missing the point. In a fold the nearest triangle is often another side's.
    """
    nearest = skin.faces[barycentric(point[None], skin)[0][0]]
    near = np.concatenate([nearest, marker.vertices])
    faces = skin.faces[np.isin(skin.faces, near).any(axis=1)]
    corners = skin.vertices[faces]
    normals = unit_rows(area_normals(skin.vertices, faces))
    arms = point - corners[:, 0]
    feet = point - np.einsum("ti,ti,tj->tj", arms, normals, normals)
    weights = np.clip(igl.barycentric_coordinates(feet, *corners.swapaxes(0, 1)), 0.0, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    over = point - np.einsum("tc,tci->ti", weights, corners)
    heights = np.einsum("ti,ti->t", over, normals)
    missed = places_over(corners, weights, heights) - point
    aside = np.linalg.norm(over - marker.height_mm * normals, axis=1)
    best = int(np.argmin(np.linalg.norm(missed, axis=1) + aside))
    (first, second, third), (one, two, three) = faces[best].tolist(), weights[best].tolist()
    vertices = (first, second, third)
    height = float(heights[best])
    return replace(marker, vertices=vertices, weights=(one, two, three), height_mm=height)


def rest_places(markers: MarkerSet, skin: Surface) -> Floats:
    """Return where markers (k, 3) lie on a person at rest, in the model's frame.

    Ignored markers have no place: NaN.
    """
    on_skin = places_over(skin.vertices[markers.vertices], markers.weights, markers.heights)
    parts = np.array([each.part for each in markers.markers])
    places = np.where((parts == "face")[:, None], on_skin, markers.places)
    return np.where((parts == "ignore")[:, None], np.nan, places)


def onto_places(points: Floats, goal: Floats, least: int = FACE.least) -> Similarity | None:
    """Return the rigid motion of markers (k, 3) onto their places; None of fewer than ``least``."""
    return robust_motion_of_seen(points, goal, BIND.slack, BIND.steps, least)


def places_of(labels: Sequence[str], markers: MarkerSet, places: Floats) -> Floats:
    """Return the ``places`` (n, 3) of a set by labels (k, 3), NaN for those that it lacks."""
    row = {label: number for number, label in enumerate(markers.labels)}
    all_places = np.vstack([places, np.full(3, np.nan)])
    return np.asarray(all_places[[row.get(label, -1) for label in labels]])


# Rims of a person's orbits. Another actor's face lies on the person's by one size for all of it,
# which may leave markers of the orbit on the lids, where they would blink.


REGIONS = ("orbit", "eye")  # what is on a lid is called so
MIDDLE = PLACES["eye"][""][0], PLACES["eye"]["inner"][1]  # of the left eye by names
PAST_LIDS_MM = 4.0  # of the rim


@dataclass(frozen=True)
class Rim:
    """The rim of an orbit as it is seen from the front: quarters of ellipses about the eye."""

    middle: Floats  # (2,) of the eyeball, mm
    low: Floats  # (2,) how far the rim is from it to the person's right, and down
    high: Floats  # (2,) and to the left, and up

    def clear(self, point: Floats, named: Named) -> Floats:
        """Return a point (3,) of the skin moved out to the rim, up or aside as its name says."""
        off = point[:2] - self.middle
        across = abs(named.place[0]) - MIDDLE[0]
        up = named.place[1] - MIDDLE[1]
        axis = int(abs(up) >= abs(across))
        sign = np.sign(up) if axis else np.sign(across) * named.side
        half = np.where(off < 0, self.low, self.high)
        other = min(abs(off[1 - axis] / half[1 - axis]), 1.0)
        least = float((self.high if sign > 0 else self.low)[axis] * np.sqrt(1.0 - other**2))
        moved = point.copy()
        moved[axis] = self.middle[axis] + sign * max(sign * off[axis], least)
        return moved


def find_rims(skin: Floats, regions: Mapping[str, Ints]) -> dict[int, Rim]:
    """Return the rims of a face's ``skin`` (V, 3) by side, 1 the left; none without its lids."""
    rims = {}
    for side, eye in ((1, "left"), (-1, "right")):
        names = [f"{eye}_eyeball", f"{eye}_upper_lid", f"{eye}_lower_lid"]
        if not all(len(regions.get(name, ())) for name in names):
            continue
        ball, *lids = (skin[regions[name]][:, :2] for name in names)
        middle = ball.mean(axis=0)
        both = np.concatenate(lids)
        low = middle - both.min(axis=0)
        high = both.max(axis=0) - middle
        rims[side] = Rim(middle, low + PAST_LIDS_MM, high + PAST_LIDS_MM)
    return rims


def clear_lids(placed: Floats, names: tuple[Named | None, ...], rims: Mapping[int, Rim]) -> Floats:
    """Return markers (n, 3) with those that are named after the orbit no nearer than its rim."""
    found = placed.copy()
    for number, named in enumerate(names):
        if named is not None and named.region in REGIONS and named.side in rims:
            found[number] = rims[named.side].clear(placed[number], named)
    return found
