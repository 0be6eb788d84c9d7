"""What a photograph shows that spoils a fit without stopping it: told, never refused.

Everything is measured within the hull of the face's landmarks, on a picture that is reduced until
the outer corners of the eyes are ``eyes_px`` apart: figures and memory are the same for pictures of
all sizes, and figures alike for MediaPipe's landmarks and 68.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_laplace
from scipy.spatial import ConvexHull, QhullError

from solver.anatomy.skin_points import SkinPoints
from solver.errors import Finding, make_warning, quote_names
from solver.photo.expression import CURVE_OPTIONS, CurveOptions, line_of
from solver.photo.photo import Photo
from solver.surface import Floats

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
# MediaPipe's numbers at each eye, all of them among the 68 points as well: outer and inner corner,
# and two points of the upper lid, each with the one below it
EYES = (
    ("33", "133", (("160", "144"), ("158", "153"))),
    ("263", "362", (("387", "373"), ("385", "380"))),
)


@dataclass(frozen=True)
class OddityOptions:
    """From where on a photograph is odd."""

    eyes_px: float = 60.0  # between the outer corners of the eyes, where a face is measured
    most_px: int = 1024  # of a side of what is measured, however far apart landmarks lie
    fine_px: tuple[float, float] = (1.0, 2.0)  # deviations of the Gaussians that are compared
    sharpness: float = 1.65  # least, of :func:`sharpness_of`
    white: float = 0.98  # sRGB of any channel; above it skin is overexposed
    black: float = 0.08  # sRGB of all channels; below it skin is underexposed
    exposed: float = 0.2  # share of the face that may be over- or underexposed
    open_eyes: float = 0.12  # height of the opening between the lids by its width
    placed: float = 0.5  # share of the landmarks that the template has a place for, at least


ODDITY_OPTIONS = OddityOptions()


def find_oddities(photo: Photo, options: OddityOptions = ODDITY_OPTIONS) -> Iterator[Finding]:
    """Yield the warnings ``photo.blurred`` and ``photo.exposure`` about a photograph's face.

    Sharpness is told of faces whose outer corners of the eyes are marked, ``eyes_px`` apart.
    """
    apart = photo.eyes_px
    face = _reduced_face(photo, apart, options)
    if face is None:
        return
    about = {"file": photo.name}
    if apart is not None and apart >= options.eyes_px:  # what is smaller is told as photo.small
        sharpness = sharpness_of(face.pixels @ LUMINANCE, face.counts, options.fine_px)
        if sharpness < options.sharpness:
            message = (
                f"{photo.name}: the face is blurred: its sharpness is {sharpness:.2f}, where "
                f"{options.sharpness:g} is wanted"
            )
            yield make_warning("photo.blurred", message, about)
    skin = face.pixels[face.counts]
    for word, share in (
        ("overexposed", float((skin > options.white).any(axis=1).mean())),
        ("underexposed", float((skin < options.black).all(axis=1).mean())),
    ):
        if share > options.exposed:
            message = f"{photo.name}: {100 * share:.0f} % of the face are {word}"
            yield make_warning("photo.exposure", message, about)


@dataclass(frozen=True)
class LeftOut:
    """Curves and landmarks beside a photograph that no skin is known for, by their names."""

    curves: tuple[str, ...]
    landmarks: tuple[str, ...]

    @classmethod
    def of(cls, photo: Photo, points: SkinPoints, options: CurveOptions = CURVE_OPTIONS) -> LeftOut:
        """Compare what is known of a photograph with the ``points`` that the template knows."""
        curves = [name for name in photo.curves if line_of(name, points, options) is None]
        marks = [name for name in photo.landmarks if not points.has(name)]
        return cls(tuple(curves), tuple(marks))


def find_left_out(
    photo: Photo, points: SkinPoints, options: OddityOptions = ODDITY_OPTIONS
) -> Iterator[Finding]:
    """Yield the notice ``photo.left_out`` about curves, and landmarks where most are left out.

    That some landmarks have no place is as it should be: a face mesh has more than a template
    knows. ``points`` are those that the template knows.
    """
    left = LeftOut.of(photo, points)
    count = len(photo.landmarks)
    has_enough = count - len(left.landmarks) >= options.placed * count
    marks = () if has_enough else left.landmarks
    if not left.curves and not marks:
        return
    parts = [f"the curve {name}" for name in left.curves]
    if marks:
        parts.append(f"{len(marks)} of {count} landmarks ({', '.join(quote_names(marks))})")
    message = (
        f"{photo.name}: left out, since the template does not know where on its skin they are: "
        f"{'; '.join(parts)}"
    )
    about = {"file": photo.name, "curves": [*left.curves], "landmarks": [*marks]}
    yield make_warning("photo.left_out", message, about)


def find_closed_eyes(
    name: str, landmarks: Mapping[str, Floats], options: OddityOptions = ODDITY_OPTIONS
) -> Iterator[Finding]:
    """Yield the warning ``photo.eyes_closed`` about the photograph ``name`` of a face at rest.

    It is told where both eyes are closed, and nothing where their lids are not marked.
    """
    openings = [each for each in (_opening(landmarks, *eye) for eye in EYES) if each is not None]
    if openings and max(openings) < options.open_eyes:
        message = f"{name}: the eyes are closed, in the photograph of the face at rest"
        yield make_warning("photo.eyes_closed", message, {"file": name})


def sharpness_of(
    grey: NDArray[np.floating], counts: NDArray[np.bool_], fine_px: tuple[float, float]
) -> float:
    """Return how much finer detail of a picture (h, w) is than coarser one, where it ``counts``.

    Deviations of the Laplacian of two Gaussians by each other: how strong contrast is drops out.
    """
    finer, coarser = (float(gaussian_laplace(grey, px)[counts].std()) for px in fine_px)
    return finer / max(coarser, 1e-6)


@dataclass(frozen=True)
class _ReducedFace:
    pixels: NDArray[np.float32]  # (h, w, 3) sRGB from 0 to 1
    counts: NDArray[np.bool_]  # (h, w), true within the face


def _reduced_face(photo: Photo, apart: float | None, options: OddityOptions) -> _ReducedFace | None:
    """Return the part of a photograph with the face, reduced; None where there is none.

    First means of whole blocks, row by row, then the rest of the way.
    """
    places = np.array([*photo.landmarks.values()]).reshape(-1, 2)
    low = np.maximum(np.floor(places.min(axis=0, initial=np.inf)), 0.0)
    high = np.minimum(np.ceil(places.max(axis=0, initial=-np.inf)), photo.size)
    if not (high > low).all():
        return None
    reduction = max(1.0, (apart or 0.0) / options.eyes_px, (high - low).max() / options.most_px)
    step = int(reduction)
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    blocks = _block_means(photo.pixels[top:bottom, left:right], step)
    if not blocks.size:
        return None
    scale = step / reduction
    height, width = (max(1, round(scale * side)) for side in blocks.shape[:2])
    size = width, height
    channels = [_resize(blocks[..., row], size) for row in range(blocks.shape[2])]
    counts = _within_hull((places - low) / reduction, size)
    if photo.mask is not None:
        shown = _block_means(photo.mask[top:bottom, left:right, None], step)[..., 0]
        counts &= _resize(shown, size) > 0.999
    return _ReducedFace(np.stack(channels, axis=2), counts) if counts.any() else None


def _block_means(pixels: NDArray[np.generic], step: int) -> NDArray[np.float32]:
    """Return the means (h // step, w // step, c) of blocks of a picture (h, w, c)."""
    height, width = (side // step for side in pixels.shape[:2])
    means = np.empty((height, width, pixels.shape[2]), np.float32)
    for row in range(height):
        band = pixels[row * step : (row + 1) * step, : width * step]
        means[row] = band.reshape(step, width, step, -1).mean(axis=(0, 2))
    return means


def _resize(channel: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return a channel (h, w) as large as ``size``, width and height, px."""
    return np.asarray(Image.fromarray(channel).resize(size, Image.Resampling.BILINEAR))


def _within_hull(places: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels (h, w) within the hull of ``places`` (k, 2)."""
    try:
        corners = places[ConvexHull(places).vertices]
    except (QhullError, ValueError):  # fewer than three, or on one line
        return np.zeros(size[::-1], bool)
    drawn = Image.new("1", size)
    ImageDraw.Draw(drawn).polygon([(x - 0.5, y - 0.5) for x, y in corners.tolist()], fill=1)
    return np.array(drawn)


def _opening(
    known: Mapping[str, Floats], outer: str, inner: str, lids: tuple[tuple[str, str], ...]
) -> float | None:
    """Return how far lids are apart by the eye's width; None where they are not marked."""
    if not {outer, inner, *(name for pair in lids for name in pair)} <= known.keys():
        return None
    heights = [float(np.linalg.norm(known[upper] - known[lower])) for upper, lower in lids]
    width = float(np.linalg.norm(known[outer] - known[inner]))
    return float(np.mean(heights)) / max(width, 1e-6)
