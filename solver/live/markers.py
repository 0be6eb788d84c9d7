"""Follow markers of a set as they come."""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from solver.live.follow import (
    FOLLOW,
    FollowedPoints,
    FollowOptions,
    LabelJudge,
    PlaceFollower,
    PlaceSource,
    ReducedPlaces,
    as_live,
)
from solver.live.source import FollowedFace
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import MarkerSet
from solver.surface import Floats


class LiveMarkers(PlaceSource):
    """Follows markers with the sliders of :func:`solver.rig.preview.make_live_preview`.

    A frame has the points (k, 3) of the set's markers, without those that it ignores, in the take's
    axes and mm, in the order of ``labels``.
    """

    def __init__(
        self,
        model: SubjectModel,
        sliders: Sliders,
        skin: ReducedSkin,
        markers: MarkerSet,
        options: FollowOptions = FOLLOW,
    ) -> None:
        used = markers.used
        self.labels = tuple(marker.label for marker in used)
        self.rows = len(used)
        self.clue_count = 3 * len(used)
        self.places = ReducedPlaces(model, sliders, skin, used)
        self._session = markers.session
        sigma = np.tile([[each.sigma_mm] for each in used], (1, 3))
        judge = LabelJudge(self.places, options)
        self._follower = PlaceFollower(self.places, sigma, len(sliders), judge, options)

    @override
    def step(self, numbers: Floats, seconds: float) -> FollowedFace:
        return as_live(self.follow(numbers, seconds))

    def follow(self, points: Floats, seconds: float) -> FollowedPoints:
        """Follow a frame and return what became of its points, too."""
        return self._follower.step(self._session(points), seconds)
