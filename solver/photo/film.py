"""Fit a film: a face frame after frame, each from the one before, by one camera.

    min over q, head    terms of the frame + w_w/2 |w|^2 + w_j/2 |j|^2
                        + sum_k (w_k - w'_k)^2 / (2 n s_w^2) + sum_i d_i^2 / (2 n s_i^2)

w' are the weights of the frame before, d the head's motion since then (a turn and a shift in the
camera's axes), s what changes in a step, as standard deviations, and n the frames since then: what
lies behind is a random walk. One focal length serves all frames. A face that is not the person's
own pulls it to one side in all of them alike, so that more frames know it no better than one: it
is the median of what a few tell by themselves, and held. Light and albedo are found once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic

import numpy as np
from scipy.spatial.transform import Rotation
from typing_extensions import override

from solver.anatomy.skin_points import SkinPoints
from solver.errors import InputError, SolveError
from solver.fitting.least_squares import (
    LeastSquaresProblem,
    LeastSquaresStep,
    LinearModel,
    StopOptions,
    TrustRegion,
    minimise,
)
from solver.mechanics.boundary import JAW_FREEDOM
from solver.photo.camera import POSE_FREEDOM, PinholeCamera
from solver.photo.expression import (
    ExpressionOptions,
    ShadingOptions,
    begin_camera,
    fit_expression,
    place_views,
    shading_of,
)
from solver.photo.fit import PhotoPoint, PhotoProblem, PhotoView
from solver.photo.light import Appearance
from solver.photo.photo import Photo
from solver.photo.shading import blocked_light
from solver.similarity import IDENTITY
from solver.surface import Floats
from solver.tracks.fit import ShapeFace, State
from solver.tracks.plain import PlainFace


@dataclass(frozen=True)
class StepNoise:
    """Standard deviations of the change from one frame to the next."""

    weight: float = 0.15  # of a shape
    turn: float = 0.05  # of the head about each of the camera's axes, rad
    shift_mm: tuple[float, float, float] = (5.0, 5.0, 15.0)  # of the head: across, down, away
    # of these: a head that seems to have moved by more was filmed anew, and is looked for
    cut: float = 12.0

    @property
    def head(self) -> Floats:
        """Return the deviations of the head's six numbers."""
        return np.array([*3 * [self.turn], *self.shift_mm])


@dataclass(frozen=True)
class FilmOptions:
    """Options of :class:`FilmTracker`."""

    expression: ExpressionOptions = field(default_factory=lambda: ExpressionOptions(shading=None))
    noise: StepNoise = field(default_factory=StepNoise)
    stop: StopOptions = field(default_factory=lambda: StopOptions(6, 3e-4, 3e-4))  # of a frame
    focal_frames: int = 7  # that tell a focal length which nobody knows


def find_focal(
    face: PlainFace, photos: Sequence[Photo], points: SkinPoints, options: FilmOptions
) -> Floats:
    """Return the focal length (2,), px, of a film: the median of what some of its frames tell.

    They are fitted by plain shapes and landmarks, which is enough for that and quick. One that
    cannot be fitted tells nothing; raises as :func:`~solver.photo.expression.fit_expression` where
    none can.
    """
    quick = replace(options.expression, shading=None)
    told = []
    fault: Exception | None = None
    for photo in photos:
        try:
            found = fit_expression(face, [photo], points, None, quick)
        except (InputError, SolveError, np.linalg.LinAlgError) as error:
            fault = error
        else:
            told.append(np.log(found.fit.point.cameras[0].focal))
    if fault is not None and not told:
        raise fault
    return np.asarray(np.exp(np.median(told, axis=0)))


class FilmTracker(Generic[State]):
    """Fits the frames of a film in their order.

    All pictures have the ``focal`` length (2,), px. ``point`` is the last frame that was fitted:
    None before the first. ``points`` are where landmarks are on the skin. ``look`` is the light, in
    the camera's axes, and the albedo that shading is compared with, if the options have it: of
    another picture in the same light, else found in the first frame. Camera and light stand still
    while the head turns.
    """

    def __init__(
        self,
        face: ShapeFace[State],
        points: SkinPoints,
        focal: Floats,
        options: FilmOptions = FilmOptions(),
    ) -> None:
        self.face = face
        self.points = points
        self.focal = focal
        self.options = options
        self.look: Appearance | None = None
        self.point: PhotoPoint[State] | None = None
        self._rest = face.rest()
        self._frames = 0  # since then

    @property
    def state(self) -> State:
        """The face as it is: at rest before the first frame."""
        return self._rest if self.point is None else self.point.state

    @property
    def needs_look(self) -> bool:
        """Whether light and albedo are still to be found in a first frame."""
        return self.options.expression.shading is not None and self.look is None

    def begin(self, q: Floats, camera: PinholeCamera) -> PhotoPoint[State]:
        """Go on from controls q (K + 5,) and a camera that a frame was fitted with before.

        Raises :class:`~solver.errors.SolveError` where the flesh finds no way to them; all stays as
        it was.
        """
        state = self.face.move(self.state, q)
        self.point = PhotoPoint(state, self.face.skin(state), IDENTITY, (camera,))
        self._frames = 0
        return self.point

    def pause(self) -> None:
        """Pass over a frame in which no face is seen."""
        self._frames += 1

    def step(self, photo: Photo) -> int:
        """Fit the next frame; ``point`` has it then. Return the steps to it.

        Raises :class:`~solver.errors.SolveError` where the flesh finds no way, and
        :class:`~solver.errors.InputError` as :func:`~solver.photo.expression.fit_expression`; the
        face stays as it was.
        """
        self._frames += 1
        seen = self.known(photo)
        self.point, steps = (
            self._first(seen) if self.point is None else self._next(seen, self.point)
        )
        self._frames = 0
        return steps

    def known(self, photo: Photo) -> Photo:
        """Return a frame with what is known of the film's camera."""
        centre = np.array(photo.size) / 2.0 if photo.camera is None else photo.camera.centre
        camera = PinholeCamera(self.focal, centre, np.eye(3), np.zeros(3))
        return replace(photo, camera=camera, is_placed=False)

    def _first(self, photo: Photo) -> tuple[PhotoPoint[State], int]:
        options = self.options.expression
        lights = None
        if self.look is not None:
            begun, _ = begin_camera(photo, self.points, self.face.skin(self.state), options)
            lights = {photo.name: self.look.turned(begun.rotation.T)}
        found = fit_expression(self.face, [photo], self.points, None, options, lights)
        if found.appearances:
            (look,) = found.appearances
            self.look = look.turned(found.fit.point.cameras[0].rotation)
        return found.fit.point, found.steps

    def _next(self, photo: Photo, before: PhotoPoint[State]) -> tuple[PhotoPoint[State], int]:
        options = self.options.expression
        skin = self.face.face.model.skin.with_vertices(before.skin)
        (view,), _head = place_views([photo], self.points, skin, options)
        camera = before.cameras[0]
        sd = np.sqrt(self._frames)
        noise = self.options.noise
        moved = np.abs(turn_and_shift(camera, view.camera)) / (sd * noise.head)
        is_cut = bool(moved.max() > noise.cut)
        if not is_cut:
            view = replace(view, camera=camera)
        fit = options.fit
        held = PhotoProblem(self.face, (view,), fit, moves_face=False)
        begun = replace(before, cameras=(view.camera,))
        placed = minimise(held, begun, TrustRegion(fit.damping), self.options.stop).point
        if options.shading is not None and self.look is not None:
            look = self.look.turned(placed.cameras[0].rotation.T)
            view = self._shade(photo, view, placed, look, options.shading)
        walk = RandomWalk(before, noise, sd, follows_head=not is_cut)
        problem = FrameProblem(PhotoProblem(self.face, (view,), fit, moves_face=True), walk)
        found = minimise(problem, placed, TrustRegion(fit.damping), self.options.stop)
        return found.point, found.steps

    def _shade(
        self,
        photo: Photo,
        view: PhotoView,
        point: PhotoPoint[State],
        look: Appearance,
        options: ShadingOptions,
    ) -> PhotoView:
        """Return the view with the light that was found on the face of the frame before, too."""
        model = self.face.face.model
        skin = model.skin.with_vertices(point.skin)
        term, _look = shading_of(
            photo, point.cameras[0], skin, model.face, blocked_light(skin), options, look
        )
        return replace(view, terms=(*view.terms, term))


def turn_and_shift(before: PinholeCamera, after: PinholeCamera) -> Floats:
    """Return the head's motion (6,) between cameras of its own frame: rad and mm."""
    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    return np.concatenate([turn, after.translation - before.translation])


@dataclass(frozen=True)
class RandomWalk(Generic[State]):
    """Prior of a frame by the one before; ``sd`` grows with the frames between them."""

    before: PhotoPoint[State]
    noise: StepNoise
    sd: float
    follows_head: bool = True  # false: it was filmed anew, and may be anywhere

    @cached_property
    def prices(self) -> Floats:
        """The precisions (K + 5 + 6,) of weights, jaw and head: the jaw has a prior of its own."""
        count = len(self.before.state.q) - JAW_FREEDOM
        head = self.noise.head if self.follows_head else np.full(POSE_FREEDOM, np.inf)
        weights = np.full(count, self.noise.weight)
        jaw = np.full(JAW_FREEDOM, np.inf)
        return np.asarray((self.sd * np.concatenate([weights, jaw, head])) ** -2.0)

    def change(self, point: PhotoPoint[State], alone: Floats) -> Floats:
        """Return what has changed since (K + 5 + 6,); ``alone`` makes a fit's variables of q."""
        head = turn_and_shift(self.before.cameras[0], point.cameras[0])
        return np.concatenate([alone @ (point.state.q - self.before.state.q), head])


@dataclass(frozen=True)
class FrameProblem(LeastSquaresProblem[PhotoPoint[State]]):
    """A picture beside what the frame before supposes.

    A head's turn since then is small: its derivative by a further one is taken for one.
    """

    picture: PhotoProblem[State]
    walk: RandomWalk[State]

    @override
    def value(self, point: PhotoPoint[State]) -> float:
        change = self.walk.change(point, self.picture.alone)
        return self.picture.value(point) + 0.5 * float(self.walk.prices @ change**2)

    @override
    def linearise(self, point: PhotoPoint[State]) -> LinearModel:
        model = self.picture.linearise(point)
        prices = self.walk.prices
        gradient = model.gradient + prices * self.walk.change(point, self.picture.alone)
        return replace(model, gradient=gradient, hessian=model.hessian + np.diag(prices))

    @override
    def move(self, point: PhotoPoint[State], step: LeastSquaresStep) -> PhotoPoint[State] | None:
        return self.picture.move(point, step)
