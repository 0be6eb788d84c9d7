"""Whether the places that cameras of one moment were given agree about the face.

Cameras that are placed in a world share one head. Each of them is let go of by itself, the face
held: where its landmarks then come much nearer, not all of the given places are right. What
another place of the head or another expression explains stays unseen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.errors import Finding, make_warning
from solver.fitting.least_squares import TrustRegion, minimise
from solver.photo.camera import PinholeCamera
from solver.photo.expression import ExpressionOptions, marks_of, place_views
from solver.photo.fit import PhotoFitOptions, PhotoPoint, PhotoProblem, PhotoView
from solver.photo.photo import Photo
from solver.similarity import IDENTITY
from solver.surface import Floats
from solver.tracks.fit import ShapeFace, State


@dataclass(frozen=True)
class PlacedOptions:
    """From where on given cameras contradict: both hold, of one photograph."""

    further_mm: float = 1.0  # that landmarks are off at the mean than by a camera of their own
    times: float = 1.3  # and by this factor


PLACED_OPTIONS = PlacedOptions()


@dataclass(frozen=True)
class Reprojection:
    """How far landmarks of a photograph are off at the mean."""

    given_px: float  # by the camera where it was placed
    alone_px: float  # by the same camera where this photograph would have it
    px_per_mm: float

    def as_dict(self) -> dict[str, float]:
        """Return both distances as JSON values."""
        return {"given_px": round(self.given_px, 2), "alone_px": round(self.alone_px, 2)}


def reprojections(
    face: ShapeFace[State],
    photos: Sequence[Photo],
    points: SkinPoints,
    point: PhotoPoint[State],
    options: ExpressionOptions,
) -> dict[str, Reprojection]:
    """Return reprojections in the ``photos`` of one moment whose cameras are placed, by name.

    ``point`` is the end of a fit to their landmarks. There are none where fewer than two are
    placed: one camera contradicts nobody.
    """
    placed = [number for number, photo in enumerate(photos) if photo.is_placed]
    if len(placed) < 2:
        return {}
    surface = face.face.model.skin.with_vertices(point.skin)
    views, _ = place_views([photos[number] for number in placed], points, surface, options)
    found = {}
    for number, view in zip(placed, views, strict=True):
        photo = photos[number]
        given = point.cameras[number]
        alone = _alone(face, view, point, given, options.fit)
        found[photo.name] = Reprojection(
            _off_px(photo, given, point.skin, points),
            _off_px(photo, alone, point.skin, points),
            float(given.focal.mean()) / float(np.median(given.project(point.skin)[:, 2])),
        )
    return found


def find_contradiction(
    found: Mapping[str, Reprojection], options: PlacedOptions = PLACED_OPTIONS
) -> list[Finding]:
    """Return the warning ``photo.cameras`` where given cameras contradict, else none."""
    if not any(
        each.given_px - each.alone_px > options.further_mm * each.px_per_mm
        and each.given_px > options.times * each.alone_px
        for each in found.values()
    ):
        return []
    told = {name: each.as_dict() for name, each in found.items()}
    listed = ", ".join(
        f"{name} {each['given_px']:g} px for {each['alone_px']:g}" for name, each in told.items()
    )
    message = (
        "the given cameras contradict: landmarks are further off than by a camera of each "
        f"photograph's own ({listed})"
    )
    return [make_warning("photo.cameras", message, {"photos": told})]


def _alone(
    face: ShapeFace[State],
    view: PhotoView,
    point: PhotoPoint[State],
    camera: PinholeCamera,
    options: PhotoFitOptions,
) -> PinholeCamera:
    """Return the camera of the head's frame that one view would have, the face held."""
    own = replace(view, camera=camera, is_placed=False)
    problem = PhotoProblem(face, (own,), options, moves_face=False)
    begun = replace(point, head=IDENTITY, cameras=(camera,))
    found = minimise(problem, begun, TrustRegion(options.damping), options.stop)
    return found.point.cameras[0]


def _off_px(photo: Photo, camera: PinholeCamera, skin: Floats, points: SkinPoints) -> float:
    known, given = marks_of(photo, points)
    seen = camera.project(known.at(skin))[:, :2]
    return float(np.linalg.norm(seen - given, axis=1).mean())
