"""Follow the points of a registered skin as they come: by some of them, spread over the face."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from typing_extensions import override

from solver.anatomy.warp import spread
from solver.fitting.markers.robust import JudgedFrame
from solver.fitting.markers.term import MarkerPlaces, MarkerTerm
from solver.live.follow import (
    ExpectedFrame,
    FollowOptions,
    PlaceFollower,
    PlaceSource,
    PointJudge,
    ReducedPlaces,
    as_live,
)
from solver.live.source import FollowedFace
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import robust_weights
from solver.surface import Floats


@dataclass(frozen=True)
class PointOptions:
    """Choice of the points that are followed, and what they are worth; lengths in mm."""

    count: int = 160  # of the face's vertices
    sigma_mm: float = 0.3  # of a point
    wrong_mm: float = 4.0  # off where it is expected, a point counts a quarter
    follow: FollowOptions = field(default_factory=lambda: FollowOptions(noise_mm=0.3))


class RobustPoints(PointJudge):
    """Points that have no labels to be wrong: what is far off where it is expected counts less."""

    def __init__(self, places: MarkerPlaces, options: PointOptions) -> None:
        self._places = places
        self._options = options

    @override
    def term(
        self, expected: ExpectedFrame, seen: Floats, precision: Floats
    ) -> tuple[JudgedFrame, MarkerTerm]:
        options = self._options
        is_seen = np.asarray(np.isfinite(seen).all(axis=1))
        used = precision * is_seen[:, None]
        term = MarkerTerm(self._places, seen, used, expected.head, options.follow.head)
        off = np.linalg.norm(term.place(expected.at).offsets, axis=1)
        weights = np.where(is_seen, robust_weights((off / options.wrong_mm) ** 2), 0.0)
        is_wrong = weights < options.follow.robust.least_weight
        states = np.select([~is_seen, is_wrong], ["missing", "outlier"], "seen")
        weighted = replace(term, precision=used * weights[:, None])
        return JudgedFrame(seen, weights, states), weighted


class LivePoints(PlaceSource):
    """Follows the vertices (V, 3) of the whole skin, mm, in any axes that a head may turn to."""

    def __init__(
        self,
        model: SubjectModel,
        sliders: Sliders,
        skin: ReducedSkin,
        options: PointOptions = PointOptions(),
    ) -> None:
        self.rows = len(model.skin.vertices)
        points = model.skin.vertices[model.face]
        nose = int(np.argmax(points[:, 2]))  # its tip is foremost
        self._used = np.sort(model.face[spread(points, options.count, nose)])
        self.clue_count = 3 * len(self._used)
        markers = [
            Marker(str(vertex), (vertex, *_neighbours(model, vertex)), sigma_mm=options.sigma_mm)
            for vertex in self._used.tolist()
        ]
        places = ReducedPlaces(model, sliders, skin, markers)
        sigma = np.full((len(markers), 3), options.sigma_mm)
        judge = RobustPoints(places, options)
        self._follower = PlaceFollower(places, sigma, len(sliders), judge, options.follow)

    @override
    def step(self, numbers: Floats, seconds: float) -> FollowedFace:
        return as_live(self._follower.step(numbers[self._used], seconds))


def _neighbours(model: SubjectModel, vertex: int) -> tuple[int, int]:
    """Return the other corners of a triangle of the skin, in its order."""
    triangle = model.skin.faces[(model.skin.faces == vertex).any(axis=1)][0].tolist()
    place = triangle.index(vertex)
    return triangle[(place + 1) % 3], triangle[(place + 2) % 3]
