"""``photo.npz``: cameras, light, colours and landmarks of fitted photographs, in full precision.

docs/reference/rig-format.md has its arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from solver.model import SubjectModel
from solver.photo.camera import PinholeCamera
from solver.photo.expression import PhotoExpression
from solver.photo.light import Appearance
from solver.photo.photo import Photo
from solver.photo.shading import CHANNELS, HARMONICS
from solver.photo.terms import LandmarkTerm, PseudoHuber
from solver.storage import Archive, Arrays
from solver.surface import Floats, Ints

FILE = "photo.npz"
FORMAT = 1
CAMERA = ("focal", "centre", "rotation", "translation")  # arrays of a camera


def photo_archive(
    model: SubjectModel,
    moments: Mapping[str, Sequence[Photo]],
    results: Mapping[str, PhotoExpression[Any]],
    loss: PseudoHuber,
) -> Archive:
    """Return what was found of the photographs of every fitted moment, by the expressions' names.

    ``loss`` is that of the fit.
    """
    names = list[str]()
    by_expression = {}
    rows: list[Arrays] = []
    marks: list[Arrays] = []
    for name, result in results.items():
        photos = moments[name]
        point = result.fit.point
        looks = result.appearances or (None,) * len(photos)
        seen = [each.vertices for each in result.compared] or [np.zeros(0, np.int64)] * len(photos)
        by_expression[name] = [photo.name for photo in photos]
        for row, photo in enumerate(photos):
            camera = point.cameras[row]
            rows.append(_photo_row(photo, camera, looks[row], model.face, seen[row]))
            marks.append(_landmarks(len(names), result.marks[row], point.skin, camera, loss))
            names.append(photo.name)
    header = {
        "format": FORMAT,
        "unit": "mm",
        "model_sha256": model.sha256,
        "photos": names,
        "expressions": by_expression,
    }
    arrays: Arrays = {"vertices": model.face}
    if rows:
        arrays |= {key: np.stack([each[key] for each in rows]) for key in rows[0]}
        arrays |= {key: np.concatenate([each[key] for each in marks]) for key in marks[0]}
    return Archive(header, arrays)


def _photo_row(
    photo: Photo, camera: PinholeCamera, look: Appearance | None, face: Ints, seen: Ints
) -> Arrays:
    """Return one photograph's row of each array; NaN for light that was not fitted."""
    light = np.full((HARMONICS, CHANNELS), np.nan)
    albedo = np.full((len(face), CHANNELS), np.nan)
    return {
        "size": np.array(photo.size),
        **{f"camera_{name}": getattr(camera, name) for name in CAMERA},
        "light": light if look is None else look.light,
        "albedo": albedo if look is None else look.albedo[face],
        "albedo_seen": np.isin(face, seen),
    }


def _landmarks(
    number: int, term: LandmarkTerm, skin: Floats, camera: PinholeCamera, loss: PseudoHuber
) -> Arrays:
    """Return a row for each landmark that the photograph of a ``number`` was compared by."""
    residual = term.residual(skin, camera).reshape(-1, 2)
    return {
        "landmark_photo": np.full(len(residual), number),
        "landmark_names": np.array(term.points.names, dtype=np.str_),
        "landmark_px": term.pixels,
        "landmark_residual_px": residual * term.noise_px[:, None],
        "landmark_noise_px": term.noise_px,
        "landmark_weights": loss.weights(residual),
    }
