"""Weights of shapes, a jaw and cameras, fitted to what photographs of one moment show.

    min over q, cameras    sum_p sum_terms rho(r) + w_l sum w + w_w/2 |w|^2 + w_j/2 |j|^2
                           + sum_p (log f_p - log f0_p)^2 / (2 sd_p^2)

The weights w are at least 0, so that their linear price is one of |w|_1: what a picture hardly
tells stays out, and what it does tell is made less by little (Tibshirani 1996). The face is one of
:mod:`solver.tracks`: flesh under muscle tracks, or plain shapes. A camera that is not known has
seven numbers, with the head's six among them: where a head is in front of its camera is all that a
picture can tell of either. Where cameras are known in a world, as of a stereo rig, the head has six
numbers there for all of their pictures. Gauss-Newton with a trust region, as scans are fitted;
robust losses are weights of each step (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic

import numpy as np
from typing_extensions import override

from solver.anatomy.template import CORRECTED
from solver.errors import SolveError
from solver.fitting.least_squares import (
    BoxModel,
    DampingOptions,
    LeastSquaresProblem,
    LeastSquaresSolution,
    LeastSquaresStep,
    Listener,
    StopOptions,
    TrustRegion,
    minimise,
)
from solver.photo.camera import CAMERA_FREEDOM, POSE_FREEDOM, PinholeCamera
from solver.photo.terms import ImageTerm, PseudoHuber
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.surface import Floats, Ints
from solver.tracks.fit import ShapeFace, State, TrackFitOptions


@dataclass(frozen=True)
class FocalPrior:
    """What is known of a focal length: its logarithm is normal about that of ``px``."""

    px: float
    deviation: float = 0.35  # of the logarithm: wide angle to portrait lens

    def residual(self, camera: PinholeCamera) -> float:
        """Return how far a camera's focal length is from it, in deviations."""
        return float(np.log(camera.focal.mean() / self.px) / self.deviation)


@dataclass(frozen=True)
class PhotoView:
    """A picture of a moment: its terms, and a camera to begin with."""

    terms: tuple[ImageTerm, ...]
    camera: PinholeCamera  # of the head's own frame, or of the world if it is placed there
    is_placed: bool = False  # whether the camera is known, with its place in the world
    focal: FocalPrior | None = None  # None: its focal length is known

    @property
    def free(self) -> Ints:
        """Return which of the camera's seven numbers are fitted."""
        if self.is_placed:
            return np.zeros(0, np.int64)
        return np.arange(CAMERA_FREEDOM if self.focal else POSE_FREEDOM)

    def value(self, skin: Floats, camera: PinholeCamera, loss: PseudoHuber) -> float:
        """Return what a skin (V, 3) costs in this picture, seen by ``camera``, in nats."""
        total = sum(loss.value(term.residual(skin, camera)) for term in self.terms)
        return total + (0.5 * self.focal.residual(camera) ** 2 if self.focal else 0.0)

    def normal_equations(
        self,
        skin: Floats,
        camera: PinholeCamera,
        columns: Floats,
        by_variables: Floats,
        loss: PseudoHuber,
    ) -> tuple[Floats, Floats]:
        """Return the gradient (n,) and Gauss-Newton's Hessian (n, n) of :meth:`value`.

        ``columns`` (3 V, k) are the derivatives of the skin by what moves it, and ``by_variables``
        (7, n - k) those of the camera by its variables, of which a free focal length is the last.
        """
        count = columns.shape[1] + by_variables.shape[1]
        gradient = np.zeros(count)
        hessian = np.zeros((count, count))
        for term in self.terms:
            found = term.linearise(skin, camera)
            weights = loss.weights(found.residual)
            jacobian = np.hstack([found.by_skin @ columns, found.by_camera @ by_variables])
            gradient += jacobian.T @ (weights * found.residual)
            hessian += jacobian.T @ (weights[:, None] * jacobian)
        if self.focal and len(self.free):
            gradient[-1] += self.focal.residual(camera) / self.focal.deviation
            hessian[-1, -1] += self.focal.deviation**-2
        return gradient, hessian


@dataclass(frozen=True)
class PhotoFitOptions:
    """Prices and bounds of controls, in units of the terms' noise, and the end of a fit."""

    controls: TrackFitOptions = field(default_factory=lambda: TrackFitOptions(w_w=0.5, w_j=1e5))
    # a linear price of each weight: what a picture hardly tells is none, not a little of all
    w_l: float = 3.0
    loss: PseudoHuber = field(default_factory=PseudoHuber)
    # changes that a linear model is surely good for: of a turn in rad, of a shift in mm and of a
    # focal length's logarithm
    turn_reach: float = 0.2
    shift_reach_mm: float = 100.0
    focal_reach: float = 0.2
    stop: StopOptions = field(default_factory=lambda: StopOptions(30, 1e-4, 1e-4))
    damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-4, least=1e-9))

    @property
    def camera_reach(self) -> Floats:
        """Return the changes (7,) of a camera that a linear model is good for."""
        turns = 3 * [self.turn_reach]
        shifts = 3 * [self.shift_reach_mm]
        return np.array([*turns, *shifts, self.focal_reach])


@dataclass(frozen=True)
class PhotoPoint(Generic[State]):
    """A face, the head in the world, and the cameras of its pictures in the head's own frame."""

    state: State
    skin: Floats  # (V, 3)
    head: Similarity
    cameras: tuple[PinholeCamera, ...]


def fit_photos(
    face: ShapeFace[State],
    views: Sequence[PhotoView],
    start: State | None = None,
    head: Similarity = IDENTITY,
    options: PhotoFitOptions = PhotoFitOptions(),
    listen: Listener | None = None,
) -> LeastSquaresSolution[PhotoPoint[State]]:
    """Fit a face and the cameras of ``views`` to them, from rest or from a ``start``; nats.

    ``head`` is where it begins in the world of placed cameras. Cameras and head are found before
    the face may move. Raises :class:`~solver.errors.SolveError` as
    :func:`solver.tracks.fit.fit`.
    """
    state = face.rest() if start is None else start
    cameras = [view.camera.with_head(head) if view.is_placed else view.camera for view in views]
    point = PhotoPoint(state, face.skin(state), head, tuple(cameras))
    search = TrustRegion(options.damping)
    held, moving = (PhotoProblem(face, tuple(views), options, moves) for moves in (False, True))
    point = minimise(held, point, search, options.stop).point
    return minimise(moving, point, search, options.stop, listen)


@dataclass(frozen=True)
class PhotoProblem(LeastSquaresProblem[PhotoPoint[State]]):
    """What :func:`fit_photos` minimises; its variables are face, head, and cameras in turn."""

    face: ShapeFace[State]
    views: tuple[PhotoView, ...]
    options: PhotoFitOptions
    moves_face: bool

    @cached_property
    def prices(self) -> Floats:
        """The prices (K + 5,) of the controls."""
        return self.options.controls.price_of(self.face.tracks)

    @cached_property
    def alone(self) -> Floats:
        """The matrix (K + 5, K + 5) from controls q to the variables of a fit.

        A corrective is a variable together with what it corrects, of which the fit varies what is
        not corrected: lips that close are those of a jaw that opens.
        """
        names = self.face.tracks.names
        matrix = np.eye(self.face.tracks.size)
        for corrective, corrected in CORRECTED.items():
            if corrective in names and corrected in names:
                matrix[names.index(corrected), names.index(corrective)] = -1.0
        return matrix

    @cached_property
    def together(self) -> Floats:
        """The matrix (K + 5, K + 5) from the variables of a fit to controls q."""
        return np.asarray(np.linalg.inv(self.alone))

    @cached_property
    def linear_prices(self) -> Floats:
        """The linear prices (K + 5,) of the controls: none of the jaw's."""
        tracks = self.face.tracks
        return np.where(np.arange(tracks.size) < len(tracks.names), self.options.w_l, 0.0)

    @cached_property
    def cameras(self) -> list[slice]:
        """Where each view's camera is among the variables: after face and head, if one is placed.

        That of a placed view is the head.
        """
        head = slice(self.size, self.size + (POSE_FREEDOM if self.has_head else 0))
        places = []
        end = head.stop
        for view in self.views:
            places.append(head if view.is_placed else slice(end, end + len(view.free)))
            end += len(view.free)
        return places

    @property
    def has_head(self) -> bool:
        """Whether the head is a variable by itself."""
        return any(view.is_placed for view in self.views)

    @property
    def size(self) -> int:
        """The number of the face's variables: none while it is held."""
        return self.face.tracks.size if self.moves_face else 0

    @override
    def value(self, point: PhotoPoint[State]) -> float:
        own = self.alone @ point.state.q
        total = float((0.5 * self.prices * own + self.linear_prices) @ own)
        for view, camera in zip(self.views, point.cameras, strict=True):
            total += view.value(point.skin, camera, self.options.loss)
        return total

    @override
    def linearise(self, point: PhotoPoint[State]) -> BoxModel:
        count = max(place.stop for place in self.cameras)
        gradient = np.zeros(count)
        hessian = np.zeros((count, count))
        face = slice(0, self.size)
        columns = self._columns(point.state)
        own = self.alone @ point.state.q
        if self.moves_face:
            gradient[face] = self.prices * own + self.linear_prices
            hessian[face, face] = np.diag(self.prices)
        for view, camera, place in zip(self.views, point.cameras, self.cameras, strict=True):
            variables = np.r_[face, place]
            if view.is_placed:
                by_variables = view.camera.head_rates(point.head)
            else:
                by_variables = np.eye(CAMERA_FREEDOM)[:, view.free]
            slope, curvature = view.normal_equations(
                point.skin, camera, columns, by_variables, self.options.loss
            )
            gradient[variables] += slope
            hessian[np.ix_(variables, variables)] += curvature
        bounds, reach = self._limits(count)
        q = np.concatenate([own[: self.size], np.zeros(count - self.size)])
        return BoxModel(q, gradient, hessian, bounds, reach)

    @override
    def move(self, point: PhotoPoint[State], step: LeastSquaresStep) -> PhotoPoint[State] | None:
        head = point.head
        if self.has_head:
            start = self.size
            head = head.then(small_motion(step.change[start : start + POSE_FREEDOM]))
        cameras = []
        for view, camera, place in zip(self.views, point.cameras, self.cameras, strict=True):
            change = np.zeros(CAMERA_FREEDOM)
            change[view.free] = step.change[place][: len(view.free)]
            cameras.append(view.camera.with_head(head) if view.is_placed else camera.moved(change))
        moved = replace(point, head=head, cameras=tuple(cameras))
        if self.moves_face:
            low, high = self.options.controls.bounds_of(self.face.tracks)
            own = np.clip(self.alone @ point.state.q + step.change[: self.size], low, high)
            q = np.clip(self.together @ own, low, high)
            try:
                state = self.face.move(point.state, q)
            except SolveError:
                return None
            moved = replace(moved, state=state, skin=self.face.skin(state))
        ahead = [camera.project(moved.skin)[:, 2].min() for camera in moved.cameras]
        return moved if min(ahead) > 0.0 else None

    def _columns(self, state: State) -> Floats:
        """Return the derivatives (3 V, K + 5) of the skin, or (3 V, 0) while it is held."""
        skin = 3 * len(self.face.face.model.skin.vertices)
        if not self.moves_face:
            return np.zeros((skin, 0))
        return self.face.skin_columns(state).reshape(skin, -1) @ self.together

    def _limits(self, count: int) -> tuple[tuple[Floats, Floats], Floats]:
        """Return bounds and reach of all ``count`` variables; head and cameras have no bounds."""
        low = high = reach = np.zeros(0)
        if self.moves_face:
            tracks = self.face.tracks
            controls = self.options.controls
            (low, high), reach = controls.bounds_of(tracks), controls.reach_of(tracks)
        open_ = np.full(count - self.size, np.inf)
        head = self.options.camera_reach[: POSE_FREEDOM if self.has_head else 0]
        own = [self.options.camera_reach[view.free] for view in self.views]
        bounds = np.concatenate([low, -open_]), np.concatenate([high, open_])
        return bounds, np.concatenate([reach, head, *own])
