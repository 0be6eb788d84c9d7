"""Who somebody is, by photographs alone: shapes of a template's people, shared by all of them.

    min over b, w_p, cameras    sum_p sum_terms rho(r) + 1/2 b . P b + w_l sum w + w_w/2 |w|^2
                                + sum_p (log f_p - log f0_p)^2 / (2 sd_p^2)

The skin in photograph p is mean + sum_i b_i I_i + sum_k w_pk E_k: identity shapes I in units of
their standard deviations among people, the same in all photographs, and the template's expressions
E, a moment's own. P is the identity of a person whose lips close (Blanz and Vetter 1999). Distance,
focal length and size go together: of a person's size a photograph tells next to nothing, and the
prior takes it from the template. Gauss-Newton with a trust region, as expressions are fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from typing_extensions import override

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import CORRECTED, ShapeBasis, Template
from solver.errors import InputError
from solver.fitting.least_squares import (
    BoxModel,
    LeastSquaresProblem,
    LeastSquaresStep,
    LinearModel,
    Listener,
    TrustRegion,
    minimise,
)
from solver.photo.camera import CAMERA_FREEDOM, PinholeCamera
from solver.photo.expression import ExpressionOptions, place_views
from solver.photo.fit import PhotoFitOptions, PhotoView
from solver.photo.photo import Photo
from solver.registration.shape_fit import IGNORED, identity_model
from solver.registration.topology import topology
from solver.surface import Floats, Surface
from solver.tracks.fit import TrackFitOptions


@dataclass(frozen=True)
class IdentityOptions:
    """Options of :func:`fit_identity`, which uses no shading, no jaw and no bounds."""

    # weights of expressions are dearer than those of a person who is known: whoever is new may
    # have full cheeks and does not puff them
    views: ExpressionOptions = field(
        default_factory=lambda: ExpressionOptions(
            fit=PhotoFitOptions(controls=TrackFitOptions(w_w=6.0), w_l=3.0)
        )
    )
    identity_reach: float = 1.0  # change of a b_i that a linear model is surely good for
    rounds: int = 2  # after the first, what a head hides is told by the head that was found


@dataclass(frozen=True)
class IdentityFit:
    """A person as photographs have them."""

    coefficients: Floats  # (m,) b, in standard deviations
    neutral: Floats  # (V, 3) mm
    weights: tuple[dict[str, float], ...]  # of expressions, one for each photograph
    skins: tuple[Floats, ...]  # (V, 3) of each photograph
    cameras: tuple[PinholeCamera, ...]
    objective: float  # nats
    steps: int


def fit_identity(
    template: Template,
    photos: Sequence[Photo],
    points: SkinPoints,
    options: IdentityOptions = IdentityOptions(),
    listen: Listener | None = None,
) -> IdentityFit:
    """Return the person of all ``photos``, each of a moment of its own, by their landmarks.

    ``points`` are where landmarks are on the template's skin. Raises :class:`InputError`:
    ``photo.no_identity`` for a template without shapes of people, and as
    :func:`~solver.photo.expression.fit_expression`.
    """
    shapes = PersonShapes.of(template)
    moments = [replace(photo, is_placed=False) for photo in photos]
    point = _Point.at_rest(shapes, len(photos))
    steps = 0
    for _ in range(options.rounds):
        seen = template.skin.with_vertices(shapes.skin(point.b, np.zeros(len(shapes.names))))
        views, _ = place_views(moments, points, seen, options.views)
        point = replace(point, cameras=tuple(view.camera for view in views))
        for moves_face in (False, True):
            problem = _IdentityProblem(shapes, tuple(views), options, moves_face)
            fit = options.views.fit
            found = minimise(problem, point, TrustRegion(fit.damping), fit.stop, listen)
            point = found.point
            steps = steps + found.steps
    neutral = shapes.skin(point.b, np.zeros(len(shapes.names)))
    weights = tuple(shapes.named(each) for each in point.weights)
    return IdentityFit(
        point.b, neutral, weights, point.skins, point.cameras, problem.value(point), steps
    )


def shapes_of(template: Template) -> ShapeBasis:
    """Return a template's shapes of people; raises :class:`InputError` (``photo.no_identity``)."""
    basis = template.shapes
    if basis is None or not len(basis.identity):
        message = "the template knows one person alone: it has no shapes of others to be found"
        raise InputError("photo.no_identity", message)
    return basis


@dataclass(frozen=True)
class SeenPerson:
    """A person who is known, in a photograph: what is seen of them, and their expression there."""

    view: PhotoView
    camera: PinholeCamera
    skin: Floats  # (V, 3)
    weights: Floats  # (K,) of the columns ``expressions``
    expressions: Floats  # (3 V, K) motions of the skin


def see_person(
    known: PersonShapes, skin: Surface, photo: Photo, points: SkinPoints, options: ExpressionOptions
) -> SeenPerson:
    """Fit a template's expressions and a camera to the landmarks of a person with known ``skin``.

    ``known`` are the template's shapes, the skin is at rest. Raises :class:`InputError` as
    :func:`~solver.photo.expression.fit_expression`.
    """
    shapes = known.of_person(skin.vertices)
    (view,), _ = place_views([replace(photo, is_placed=False)], points, skin, options)
    point = replace(_Point.at_rest(shapes, 1), cameras=(view.camera,))
    for moves_face in (False, True):
        problem = _IdentityProblem(shapes, (view,), IdentityOptions(options), moves_face)
        point = minimise(problem, point, TrustRegion(options.fit.damping), options.fit.stop).point
    return SeenPerson(view, point.cameras[0], point.skins[0], point.weights[0], shapes.columns)


@dataclass(frozen=True)
class PersonShapes:
    """Shapes of people and of expressions, as columns of motions of the skin."""

    mean: Floats  # (V, 3)
    prior: Floats  # (m, m) P
    columns: Floats  # (3 V, m + K)
    names: tuple[str, ...]  # (K,) of the expressions that a photograph shows

    @classmethod
    def of(cls, template: Template) -> PersonShapes:
        """Return the shapes of a template; correctives come with what they correct."""
        basis = shapes_of(template)
        known = dict(zip(basis.expression_names, basis.expressions, strict=True))
        shown = [name for name in known if not name.startswith(IGNORED)]
        moved = [
            known[name] + known[CORRECTED[name]] if CORRECTED.get(name) in known else known[name]
            for name in shown
        ]
        motions = np.concatenate([basis.identity, np.array(moved)]).astype(np.float64)
        prior = identity_model(topology(template), basis).prior
        columns = motions.reshape(len(motions), -1).T.copy()
        return cls(template.skin.vertices, prior, columns, tuple(shown))

    @property
    def identity(self) -> Floats:
        """The motions (3 V, m) of people's shapes alone."""
        return self.columns[:, : len(self.prior)]

    def of_person(self, neutral: Floats) -> PersonShapes:
        """Return the shapes of one person alone, whose skin (V, 3) is known."""
        expressions = self.columns[:, len(self.prior) :]
        return replace(self, mean=neutral, prior=np.zeros((0, 0)), columns=expressions)

    def skin(self, b: Floats, weights: Floats) -> Floats:
        """Return the skin (V, 3) of a person b (m,) with ``weights`` (K,) of expressions."""
        moved = self.columns @ np.concatenate([b, weights])
        return np.asarray(self.mean + moved.reshape(self.mean.shape))

    def named(self, weights: Floats) -> dict[str, float]:
        """Return weights (K,) by the template's own expressions."""
        found = dict(zip(self.names, weights.tolist(), strict=True))
        for name, corrected in CORRECTED.items():
            if name in found and corrected in found:
                found[corrected] += found[name]
        return found


@dataclass(frozen=True)
class _Point:
    """A person, and what each photograph shows of them: weights (K,), skin (V, 3) and camera."""

    b: Floats
    weights: tuple[Floats, ...]
    skins: tuple[Floats, ...]
    cameras: tuple[PinholeCamera, ...] = ()

    @classmethod
    def at_rest(cls, shapes: PersonShapes, photos: int) -> _Point:
        """Return the template's own person at rest in every photograph."""
        none = np.zeros(len(shapes.names))
        return cls(np.zeros(len(shapes.prior)), (none,) * photos, (shapes.mean,) * photos)


@dataclass(frozen=True)
class _IdentityProblem(LeastSquaresProblem[_Point]):
    shapes: PersonShapes
    views: tuple[PhotoView, ...]
    options: IdentityOptions
    moves_face: bool

    @cached_property
    def person(self) -> slice:
        """Where b is among the variables: first; nowhere while the face is held."""
        return slice(0, len(self.shapes.prior) if self.moves_face else 0)

    @cached_property
    def places(self) -> list[tuple[slice, slice]]:
        """Where the weights and the camera of each photograph are among the variables."""
        found = []
        end = self.person.stop
        for view in self.views:
            middle = end + (len(self.shapes.names) if self.moves_face else 0)
            found.append((slice(end, middle), slice(middle, middle + len(view.free))))
            end = middle + len(view.free)
        return found

    @override
    def value(self, point: _Point) -> float:
        fit = self.options.views.fit
        total = 0.5 * float(point.b @ self.shapes.prior @ point.b)
        for view, weights, skin, camera in zip(
            self.views, point.weights, point.skins, point.cameras, strict=True
        ):
            total += float((0.5 * fit.controls.w_w * weights + fit.w_l) @ weights)
            total += view.value(skin, camera, fit.loss)
        return total

    @override
    def linearise(self, point: _Point) -> LinearModel:
        fit = self.options.views.fit
        count = self.places[-1][1].stop
        gradient = np.zeros(count)
        hessian = np.zeros((count, count))
        q = np.zeros(count)
        low = np.full(count, -np.inf)
        high = np.full(count, np.inf)
        reach = np.ones(count)
        columns = self.shapes.columns[:, : None if self.moves_face else 0]
        if self.moves_face:
            q[self.person] = point.b
            gradient[self.person] = self.shapes.prior @ point.b
            hessian[self.person, self.person] = self.shapes.prior
            reach[self.person] = self.options.identity_reach
        for number, (view, (own, place)) in enumerate(zip(self.views, self.places, strict=True)):
            variables = np.r_[self.person, own, place]
            by_variables = np.eye(CAMERA_FREEDOM)[:, view.free]
            slope, curvature = view.normal_equations(
                point.skins[number], point.cameras[number], columns, by_variables, fit.loss
            )
            gradient[variables] += slope
            hessian[np.ix_(variables, variables)] += curvature
            reach[place] = fit.camera_reach[view.free]
            if self.moves_face:
                q[own] = point.weights[number]
                gradient[own] += fit.controls.w_w * point.weights[number] + fit.w_l
                hessian[own, own] += fit.controls.w_w * np.eye(own.stop - own.start)
                low[own], high[own] = fit.controls.bounds
                reach[own] = fit.controls.weight_reach
        return BoxModel(q, gradient, hessian, (low, high), reach)

    @override
    def move(self, point: _Point, step: LeastSquaresStep) -> _Point | None:
        cameras = []
        for view, camera, (_, place) in zip(self.views, point.cameras, self.places, strict=True):
            change = np.zeros(CAMERA_FREEDOM)
            change[view.free] = step.change[place]
            cameras.append(camera.moved(change))
        moved = replace(point, cameras=tuple(cameras))
        if self.moves_face:
            b = point.b + step.change[self.person]
            bounds = self.options.views.fit.controls.bounds
            weights = tuple(
                np.clip(each + step.change[own], *bounds)
                for each, (own, _) in zip(point.weights, self.places, strict=True)
            )
            skins = tuple(self.shapes.skin(b, each) for each in weights)
            moved = replace(moved, b=b, weights=weights, skins=skins)
        ahead = [
            camera.project(skin)[:, 2].min()
            for camera, skin in zip(moved.cameras, moved.skins, strict=True)
        ]
        return moved if min(ahead) > 0.0 else None
