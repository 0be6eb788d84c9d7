"""Follow MediaPipe's landmarks as they come: places in a picture by an unknown camera.

A frame's landmarks are in pixels or any other unit, x to the right, y down and z away from the
camera. The size of a unit is found in every frame, by the similarity that takes the face as it is
expected to what was seen, and the camera's distance by all (:mod:`solver.live.perspective`); depth,
which a detector guesses, counts less.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from typing_extensions import override

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.warp import spread
from solver.errors import InputError
from solver.fitting.markers.robust import RobustOptions
from solver.live.follow import FollowOptions, PlaceFollower, PlaceSource, ReducedPlaces, as_live
from solver.live.perspective import Perspective, PerspectiveOptions
from solver.live.points import PointOptions, RobustPoints
from solver.live.source import FollowedFace
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import Similarity
from solver.surface import Floats

Number = TypeVar("Number", int, float)

COUNT = 478  # landmarks of a frame, the last ten of the irises
IMAGE_AXES = np.diag([1.0, -1.0, -1.0])  # of a picture in those of a face that looks out of it


@dataclass(frozen=True)
class LandmarkOptions:
    """What landmarks are worth; lengths in mm."""

    least: int = 20  # that a template must have, and a frame must show
    depth: float = 4.0  # times as uncertain as in the picture's plane
    spread: float = 0.5  # part of a landmark's spread over pictures that is noise of a frame
    point: float = 1e-6  # extent of landmarks that are one point, by how far that is from 0
    perspective: PerspectiveOptions = field(default_factory=PerspectiveOptions)
    follow: PointOptions = field(
        default_factory=lambda: PointOptions(
            wrong_mm=8.0, follow=FollowOptions(noise_mm=1.0, robust=RobustOptions(scale_mm=4.0))
        )
    )


class LiveLandmarks(PlaceSource):
    """Follows the landmarks (478, 3) of a detector, at the ``points`` that a template has of them.

    Those that count are far from each other: where landmarks are dense, as about eyes and lips,
    they would outweigh the rest of the face.

    Raises :class:`InputError` (``live.no_landmarks``) where that has too few.
    """

    rows = COUNT

    def __init__(
        self,
        model: SubjectModel,
        sliders: Sliders,
        skin: ReducedSkin,
        points: SkinPoints,
        options: LandmarkOptions = LandmarkOptions(),
    ) -> None:
        found = points.detected()
        found = found.select([name for name in found.names if int(name) < COUNT])
        if len(found.names) < options.least:
            message = (
                f"the template has {len(found.names)} of a detector's landmarks, of which "
                f"{options.least} are needed: send weights instead"
            )
            about = {"found": len(found.names), "expected": options.least}
            raise InputError("live.no_landmarks", message, **about)
        at_rest = found.of(model.skin.vertices)
        nose = int(np.argmax(at_rest[:, 2]))  # its tip is foremost
        chosen = np.sort(spread(at_rest, min(options.follow.count, len(at_rest)), nose))
        found = found.select([found.names[number] for number in chosen])
        self._used = np.array([int(name) for name in found.names])
        self._options = options
        self.clue_count = 3 * len(self._used)
        markers = [
            Marker(name, _three(corners), _three(weights))
            for name, corners, weights in zip(
                found.names, found.corners.tolist(), found.weights.tolist(), strict=True
            )
        ]
        self._places = ReducedPlaces(model, sliders, skin, markers)
        sigma = options.spread * found.spread_mm[:, None] * [1.0, 1.0, options.depth]
        self.perspective = Perspective(options.perspective)
        judge = RobustPoints(self._places, options.follow)
        own = options.follow.follow
        self._follower = PlaceFollower(self._places, sigma, len(sliders), judge, own)

    @override
    def step(self, numbers: Floats, seconds: float) -> FollowedFace:
        seen = numbers[self._used] @ IMAGE_AXES
        known = np.isfinite(seen).all(axis=1)
        if known.sum() < self._options.least or self._is_point(seen[known]):
            return as_live(self._follower.step(np.full_like(seen, np.nan), seconds))
        at = self._places.at(self._follower.memory.values)
        flat = self.perspective.flatten(seen, at, seconds)
        return as_live(self._follower.step(flat, seconds))

    def _is_point(self, seen: Floats) -> bool:
        """Return whether places (k, 3) are one, as some detectors say that they see no face."""
        return bool(np.ptp(seen, axis=0).max() <= self._options.point * np.abs(seen).max())

    @override
    def begin(self) -> None:
        super().begin()
        self.perspective.begin()

    @override
    def resume(self, values: Floats, head: Similarity) -> None:
        super().resume(values, head)
        self.perspective.begin()


def _three(each: list[Number]) -> tuple[Number, Number, Number]:
    first, second, third = each
    return first, second, third
