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
    ReducedPlaces,
)
from solver.live.source import FollowedFace, LiveSource
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import MarkerSet
from solver.similarity import Similarity
from solver.surface import Floats


class LiveMarkers(LiveSource):
    """Follows markers with the sliders of :func:`solver.rig.preview.make_live_preview`.

    A frame has the points (k, 3) of the set's markers, without those that it ignores, in the take's
    axes and mm, in the order of ``labels``.
    """

    width = 3

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

    @override
    def begin(self) -> None:
        self._follower.begin()

    @override
    def resume(self, values: Floats, head: Similarity) -> None:
        self._follower.resume(values, head)


def as_live(found: FollowedPoints) -> FollowedFace:
    """Return followed points as a session has them."""
    left = np.nan_to_num(found.residuals.ravel())
    is_held = not np.isin(found.states, ("missing", "outlier"), invert=True).any()
    return FollowedFace(found.values, found.head, left, is_held)
