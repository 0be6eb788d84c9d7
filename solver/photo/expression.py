"""Fit one expression to photographs of one moment: cameras, then landmarks, then shading.

First what landmarks say, of head, jaw and weights; then light and albedo as that face has them,
and the differences between picture and shaded skin beside the landmarks. Residuals of neighbours
err together: a shadow that nine numbers of light do not hold lies on a whole cheek, a detector
that takes a lip for open takes all of its points along. So a term counts as a stated number of
independent residuals, however many points or pixels it has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic

import numpy as np

from solver.anatomy.skin_points import SkinPoints
from solver.drawing.render import GAMMA
from solver.errors import InputError
from solver.fitting.least_squares import LeastSquaresSolution, Listener
from solver.photo.camera import PinholeCamera
from solver.photo.compared import ComparedOptions, ComparedSkin
from solver.photo.fit import FocalPrior, PhotoFitOptions, PhotoPoint, PhotoView, fit_photos
from solver.photo.light import (
    Appearance,
    LightOptions,
    PixelOptions,
    find_appearance,
    visible_samples,
)
from solver.photo.photo import Photo, square_around
from solver.photo.pose import LEAST_POINTS, place_camera
from solver.photo.shading import ShadingTerm, SmoothImage, blocked_light, facing
from solver.photo.terms import CurveTerm, ImageTerm, LandmarkTerm
from solver.registration.detector import LINES
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Ints, Surface
from solver.tracks.fit import ShapeFace, State


@dataclass(frozen=True)
class LandmarkTrust:
    """How far landmarks of a picture may be trusted."""

    noise_mm: float = 1.2  # standard deviation of a coordinate, as far as it is the detector's
    independent: int = 60  # of so many points at most each counts by itself
    # least cosine between skin and camera: beyond, a detector guesses what the head hides
    least_cosine: float = 0.15


@dataclass(frozen=True)
class CurveOptions:
    """How far outlines that were traced may be trusted."""

    noise_mm: float = 0.7  # standard deviation of the distance from a line of the skin
    independent: int = 15  # of so many places on a curve each counts by itself
    step_mm: float = 1.0  # between the places that a curve is taken at
    least_points: int = 8  # of the skin's line, that the template has to know
    far_mm: float = 30.0  # from the middle of that line's landmarks: it was traced somewhere else


CURVE_OPTIONS = CurveOptions()


@dataclass(frozen=True)
class ShadingOptions:
    """The comparison of a picture with the shaded skin."""

    detail_mm: float = 1.0  # what is finer in the picture is left out
    # least standard deviation of a channel, by the mean of the skin's; more where light and albedo
    # leave more of a picture, as of brows, a beard and gloss
    least_noise: float = 0.05
    independent: int = 20  # of so many samples each counts by itself
    samples: PixelOptions = field(default_factory=PixelOptions)
    light: LightOptions = field(default_factory=LightOptions)
    compared: ComparedOptions = field(default_factory=ComparedOptions)


@dataclass(frozen=True)
class FocalOptions:
    """Prior of an unknown focal length."""

    sides: float = 1.3  # times the picture's longer side, px
    deviation: float = 0.35  # of its logarithm: wide angle to portrait lens
    told_deviation: float = 0.05  # where the file tells it


@dataclass(frozen=True)
class ExpressionOptions:
    """Options of :func:`fit_expression`."""

    fit: PhotoFitOptions = field(default_factory=PhotoFitOptions)
    landmarks: LandmarkTrust = field(default_factory=LandmarkTrust)
    curves: CurveOptions = field(default_factory=CurveOptions)
    shading: ShadingOptions | None = field(default_factory=ShadingOptions)
    focal: FocalOptions = field(default_factory=FocalOptions)


@dataclass(frozen=True)
class PhotoExpression(Generic[State]):
    """A fit to photographs, and what each of them showed the skin to look like."""

    fit: LeastSquaresSolution[PhotoPoint[State]]
    # the fit to landmarks alone, which it begins with
    landmarks: LeastSquaresSolution[PhotoPoint[State]]
    marks: tuple[LandmarkTerm, ...]  # of each photograph, as they were compared
    appearances: tuple[Appearance, ...]  # one for each photograph; none without shading
    compared: tuple[ComparedSkin, ...] = ()  # the same of the skin

    @property
    def steps(self) -> int:
        """The steps of both fits, which are one without shading."""
        return self.landmarks.steps + (self.fit.steps if self.appearances else 0)


def fit_expression(
    face: ShapeFace[State],
    photos: Sequence[Photo],
    points: SkinPoints,
    start: State | None = None,
    options: ExpressionOptions = ExpressionOptions(),
    lights: Mapping[str, Appearance] | None = None,
    listen: Listener | None = None,
) -> PhotoExpression[State]:
    """Fit a face to ``photos`` of one moment, from rest or from a ``start``.

    ``points`` are where landmarks are on the skin; those of a photograph that are not among them
    are left out. ``lights`` are known appearances by the photographs' names, as of a neutral
    picture in the same light; others are found in the picture itself. Raises
    :class:`InputError` (``photo.pose`` for too few landmarks, ``photo.curve``, ``photo.no_skin``),
    and as :func:`fit_photos`.
    """
    begun = face.rest() if start is None else start
    surface = face.face.model.skin.with_vertices(face.skin(begun))
    views, head = place_views(photos, points, surface, options)
    by_landmarks = fit_photos(face, views, begun, head, options.fit, listen)
    marks = tuple(term for view in views for term in view.terms if isinstance(term, LandmarkTerm))
    if options.shading is None:
        return PhotoExpression(by_landmarks, by_landmarks, marks, ())
    skin = face.face.model.skin.with_vertices(by_landmarks.point.skin)
    blocked = blocked_light(skin)
    shaded = []
    looks = []
    terms = []
    for photo, view, camera in zip(photos, views, by_landmarks.point.cameras, strict=True):
        given = (lights or {}).get(photo.name)
        term, look = shading_of(
            photo, camera, skin, face.face.model.face, blocked, options.shading, given
        )
        own = view.camera if view.is_placed else camera
        shaded.append(replace(view, camera=own, terms=(*view.terms, term)))
        looks.append(look)
        terms.append(term)
    point = by_landmarks.point

    def further(step: int, value: float) -> None:
        if listen is not None:
            listen(by_landmarks.steps + step, value)

    found = fit_photos(face, shaded, point.state, point.head, options.fit, further)
    compared = [
        ComparedSkin.of(term, found.point.skin, camera, options.fit.loss, options.shading.compared)
        for term, camera in zip(terms, found.point.cameras, strict=True)
    ]
    return PhotoExpression(found, by_landmarks, marks, tuple(looks), tuple(compared))


@dataclass(frozen=True)
class NeutralLook:
    """What a photograph of the neutral face tells of all others of the same person.

    ``points`` are where the detector marks them on this person; ``appearance`` is light and albedo
    as the ``camera`` sees them, None without shading.
    """

    points: SkinPoints
    appearance: Appearance | None
    camera: PinholeCamera


def read_neutral(
    face: ShapeFace[State],
    photo: Photo,
    points: SkinPoints,
    options: ExpressionOptions = ExpressionOptions(),
) -> NeutralLook:
    """Return what a photograph of the face at rest tells; raises as :func:`fit_expression`.

    A detector marks a person's points at places of that person's own, alike in all expressions:
    what landmarks are off in this picture is the person's, and no expression.
    """
    controls = replace(options.fit.controls, bounds=(0.0, 0.0), w_j=1e9)
    still = replace(options, fit=replace(options.fit, controls=controls))
    found = fit_expression(face, [photo], points, options=still)
    camera = found.fit.point.cameras[0]
    skin = found.fit.point.skin
    known, pixels = marks_of(photo, points)
    seen = camera.project(known.at(skin))
    # in the camera's plane: how deep a place lies, a picture does not tell
    offsets = (pixels - seen[:, :2]) / camera.focal * seen[:, 2:] @ camera.rotation[:2]
    surface = face.face.model.skin.with_vertices(skin)
    shown = facing(known, surface, camera)
    own = {
        name: offset
        for name, offset, cosine in zip(known.names, offsets, shown, strict=True)
        if cosine > options.landmarks.least_cosine
    }
    return NeutralLook(points.moved(own), next(iter(found.appearances), None), camera)


def shading_of(
    photo: Photo,
    camera: PinholeCamera,
    skin: Surface,
    vertices: Ints,
    blocked: Floats,
    options: ShadingOptions,
    given: Appearance | None = None,
) -> tuple[ShadingTerm, Appearance]:
    """Return the term of a picture's shading, and light and albedo, found unless ``given``.

    Its noise is what these leave of the picture on the ``skin`` that the fit begins with.
    ``vertices`` of the skin are compared; ``blocked`` (V, 9) is what it blocks of the light.
    Raises :class:`InputError` (``photo.no_skin``) where the picture shows none of it.
    """
    left, top, right, bottom = square_around(camera.project(skin.vertices[vertices])[:, :2], photo)
    part = slice(top, bottom), slice(left, right)
    pixels = np.asarray(photo.pixels[part], np.float64) ** GAMMA
    mask = None if photo.mask is None else photo.mask[part]
    px_per_mm = camera.focal.mean() / float(np.median(camera.project(skin.vertices)[:, 2]))
    detail = max(options.detail_mm * px_per_mm, 0.7)
    every = max(round(detail), 1)
    inside = replace(camera, centre=camera.centre - (left, top))
    samples, share = visible_samples(skin, vertices, inside, pixels, every, mask, options.samples)
    if len(samples.corners) < options.samples.least:
        message = (
            f"{photo.name}: too little skin is left to compare with the picture: what of the face "
            "is not hidden or masked is black or white; landmarks alone can be fitted without "
            "shading"
        )
        raise InputError("photo.no_skin", message, photo=photo.name)
    image = SmoothImage.blurred(pixels, detail, (left, top))
    colours = image.at(camera.project(samples.of(skin.vertices))[:, :2])
    look = given or find_appearance(skin, samples, colours, blocked, options.light)
    term = ShadingTerm(
        image, skin.faces, samples, samples.of(look.albedo), samples.of(blocked), look.light
    )
    unexplained = float(np.sqrt(np.mean(term.residual(skin.vertices, camera) ** 2)))
    noise = max(options.least_noise * float(colours.mean()), unexplained)
    count = max(len(samples.corners) / options.independent, 1.0)
    return replace(term, noise=noise * np.sqrt(count), share=share), look


def place_views(
    photos: Sequence[Photo], points: SkinPoints, skin: Surface, options: ExpressionOptions
) -> tuple[list[PhotoView], Similarity]:
    """Return every photograph's landmarks with a camera to begin with, and where the head is.

    Cameras are those that see the ``skin`` so. Raises as :func:`fit_expression`.
    """
    views = []
    head = None
    for photo in photos:
        known, pixels = marks_of(photo, points)
        places = known.at(skin.vertices)
        begun, prior = begin_camera(photo, points, skin.vertices, options)
        cosine = facing(known, skin, begun)
        shown = cosine > options.landmarks.least_cosine
        known = known.select(
            [name for name, is_seen in zip(known.names, shown, strict=True) if is_seen]
        )
        if len(known.names) < LEAST_POINTS:
            message = (
                f"{photo.name}: the camera sees {len(known.names)} of its {len(shown)} landmarks "
                f"from the front, at least {LEAST_POINTS} are needed: left and right may be "
                "exchanged"
            )
            about = {"found": len(known.names), "expected": LEAST_POINTS}
            raise InputError("photo.pose", message, photo=photo.name, **about)
        pixels = pixels[shown]
        places = places[shown]
        mm = _noise_mm(known, options.landmarks)
        noise = mm * begun.focal.mean() / begun.project(places)[:, 2]
        px_per_mm = float(np.median(noise / mm))
        term = LandmarkTerm(known, pixels, noise)
        terms = (term, *_curve_terms(photo, points, px_per_mm, options.curves))
        if photo.is_placed and photo.camera is not None:
            head = photo.camera.head_of(begun) if head is None else head
            views.append(PhotoView(terms, photo.camera, is_placed=True))
        else:
            views.append(PhotoView(terms, begun, focal=prior))
    return views, head or IDENTITY


def begin_camera(
    photo: Photo, points: SkinPoints, skin: Floats, options: ExpressionOptions = ExpressionOptions()
) -> tuple[PinholeCamera, FocalPrior | None]:
    """Return a camera that sees a skin (V, 3) about so, and what is known of its focal length.

    Raises :class:`InputError` (``photo.pose``) where the landmarks place none.
    """
    known, pixels = marks_of(photo, points)
    focal, prior = _focal(photo, options.focal)
    centre = np.array(photo.size) / 2.0 if photo.camera is None else photo.camera.centre
    noise = _noise_mm(known, options.landmarks)
    try:
        return place_camera(known.at(skin), pixels, noise, focal, centre), prior
    except InputError as error:
        raise InputError(error.code, f"{photo.name}: {error}", photo=photo.name) from error


def marks_of(photo: Photo, points: SkinPoints) -> tuple[SkinPoints, Floats]:
    """Return the ``points`` that a photograph shows, and where it shows them (k, 2), px."""
    names = [name for name in points.names if name in photo.landmarks]
    return points.select(names), np.array([photo.landmarks[n] for n in names]).reshape(-1, 2)


def _curve_terms(
    photo: Photo, points: SkinPoints, px_per_mm: float, options: CurveOptions
) -> list[ImageTerm]:
    """Return the terms of a photograph's curves whose lines on the skin are known.

    Raises :class:`InputError` (``photo.curve``) for one that is elsewhere than its landmarks.
    """
    terms: list[ImageTerm] = []
    for name, traced in photo.curves.items():
        line = line_of(name, points, options)
        if line is None:  # which is told as an oddity
            continue
        marked = [photo.landmarks[each] for each in line.names if each in photo.landmarks]
        if marked:
            away = np.linalg.norm(np.mean(marked, axis=0) - traced.mean(axis=0)) / px_per_mm
            if away > options.far_mm:
                message = f"{photo.name}: the curve {name} is {away:.0f} mm from its landmarks"
                raise InputError("photo.curve", message, photo=photo.name, where=name)
        places = evenly(traced, options.step_mm * px_per_mm)
        spread = np.hypot(options.noise_mm, float(np.median(line.spread_mm)) / np.sqrt(2.0))
        repeated = np.sqrt(max(len(places) / options.independent, 1.0))
        terms.append(CurveTerm(line, places, float(spread * px_per_mm * repeated)))
    return terms


def line_of(name: str, points: SkinPoints, options: CurveOptions) -> SkinPoints | None:
    """Return the skin's line that a curve is of; None where too few of its points are known."""
    line = points.select([number for number in LINES[name] if points.has(number)])
    return None if len(line.names) < options.least_points else line


def evenly(curve: Floats, step: float) -> Floats:
    """Return places (n, 2) on a polyline (k, 2), about ``step`` from one to the next."""
    lengths = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(round(along[-1] / step), 2)
    wanted = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(wanted, along, curve[:, axis]) for axis in range(2)])


def _noise_mm(points: SkinPoints, options: LandmarkTrust) -> Floats:
    """Return the standard deviations (k,) of points, so that together they count as they may."""
    # a spread is that of both coordinates together
    each = np.hypot(options.noise_mm, points.spread_mm / np.sqrt(2.0))
    return np.asarray(each * np.sqrt(max(len(each) / options.independent, 1.0)))


def _focal(photo: Photo, options: FocalOptions) -> tuple[Floats, FocalPrior | None]:
    """Return a focal length (2,) to begin with, and what is known of it."""
    if photo.camera is not None:
        return photo.camera.focal, None
    if photo.focal_px is not None:
        return np.full(2, photo.focal_px), FocalPrior(photo.focal_px, options.told_deviation)
    guess = options.sides * max(photo.size)
    return np.full(2, guess), FocalPrior(guess, options.deviation)
