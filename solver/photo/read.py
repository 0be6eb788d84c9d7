"""Read a photograph with what is known of it, and take its lens's distortion out once."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from solver.errors import InputError
from solver.photo.camera import Lens
from solver.photo.facts import ROUNDS, Facts, read_facts
from solver.photo.photo import Photo
from solver.photo.picture import Picture, read_mask, read_picture

BAND = 1 << 20  # pixels that are undistorted at a time


def read_photo(
    path: Path, facts: Path | None = None, mask: Path | None = None, names: Collection[str] = ()
) -> Photo:
    """Return the photograph of a JPEG or PNG file, upright and as a pinhole sees it.

    ``facts`` is the JSON beside it (:class:`~solver.kinds.photo.PhotoDocument`), ``mask`` a PNG
    that is white where the picture counts; where it is transparent, it does not either. ``names``
    are landmarks of a template of one's own, beside those that all templates share. Raises
    :class:`InputError` (``photo.*``) naming the file and, in facts, the place.
    """
    picture = read_picture(path)
    known = Facts() if facts is None else read_facts(facts, picture, names)
    pixels = picture.pixels
    shown = _shown(path, picture, mask)
    landmarks = dict(known.landmarks)
    curves = dict(known.curves)
    if (lens := known.lens) is not None:
        pixels, shown = _undistort(lens, pixels, shown)
        curves = {name: lens.undistort(curve, ROUNDS) for name, curve in curves.items()}
        places = lens.undistort(np.array([*landmarks.values()]).reshape(-1, 2), ROUNDS)
        landmarks = dict(zip(landmarks, places, strict=True))
    known_by_file = pixels, known.camera, picture.focal_px
    return Photo(path.stem, *known_by_file, landmarks, curves, shown, known.is_placed)


def _shown(path: Path, picture: Picture, mask: Path | None) -> NDArray[np.bool_] | None:
    """Return where a picture counts (h, w); None: everywhere."""
    shown = picture.opaque
    if mask is not None:
        white = read_mask(mask, picture)
        shown = white if shown is None else white & shown
    if shown is not None and not shown.any():
        message = f"{path.name}: nothing of the picture is left: it is transparent where it counts"
        raise InputError("photo.mask_empty", message, file=path.name)
    return shown


def _undistort(
    lens: Lens, pixels: NDArray[np.float32], shown: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Return picture and mask resampled as a pinhole camera sees them, by linear interpolation.

    What the lens did not see does not count.
    """
    height, width = pixels.shape[:2]
    found = np.zeros_like(pixels)
    counts = np.zeros((height, width), bool)
    rows = max(1, BAND // width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        grid = np.mgrid[band, 0:width].reshape(2, -1)[::-1].T + 0.5
        sources = lens.distort(grid)
        places = sources[:, ::-1].T - 0.5  # as SciPy counts: rows first, middles whole
        inside = ((sources >= 0.0) & (sources <= (width, height))).all(axis=1)
        for channel in range(3):
            values = map_coordinates(pixels[..., channel], places, order=1, mode="nearest")
            found[band, :, channel] = np.where(inside, values, 0.0).reshape(-1, width)
        if shown is not None:
            inside &= map_coordinates(shown.astype(np.uint8), places, order=0, mode="nearest") > 0
        counts[band] = inside.reshape(-1, width)
    return found, None if counts.all() else counts
