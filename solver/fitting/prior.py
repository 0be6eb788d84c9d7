"""Say how probable a pose is: normal distributions over the controls, from known expressions.

    N(rest, C),    C = sum_e (sd^2 dq_e dq_e^T + sum_j s^2 dq_ej dq_ej^T) + diag(floor^2)

with dq_e the change of the controls that makes expression e: of a template's shapes by the flesh's
linear response at rest, or as fitted, as of a rig's scans. dq_ej is the part of muscle j alone (or
of the jaw): a few scans span few poses, but a muscle may do by itself what it does in one of them.

Over time a control forgets: its correlation after dt is exp(-dt / time), so that with nothing seen
it goes back to the rest (Ornstein and Uhlenbeck 1930), and the spread of the frame before grows by
(1 - exp(-2 dt / time)) C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.errors import SolveError
from solver.fitting.activation import ActivationOptions, fit, rest_curvature, unseen_regulariser
from solver.fitting.controls import Layout
from solver.fitting.face import Face, Pose
from solver.fitting.information import inverse_of_positive
from solver.fitting.objective import Prior, SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.jaw_tracks import nearest_jaw
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class PriorOptions:
    """Strength of expressions, and the spread of what none of them does."""

    strength: float = 0.5  # standard deviation of an expression's amount
    own_strength: float = 0.0  # of a muscle's amount by itself
    known: Literal["template", "scans", "nothing"] = "template"  # which of a block's spreads holds
    large_mm: float = 1.0  # mean motion of the face from which a shape is fitted ...
    fitted_parts: tuple[float, ...] = (0.5,)  # ... at these parts of it, ...
    fitted_from: float = 0.7  # ... from so much of what is linear
    # the same for a jaw on tracks, which is held where the shape has the teeth: muscles that make
    # up for flesh far off them do so otherwise half way
    parts_on_tracks: tuple[float, ...] = (0.5, 1.0)
    held: float = 100.0  # weight of that, per squared unit of the jaw
    effort: ActivationOptions = field(default_factory=lambda: ActivationOptions(8, tolerance=3e-3))


# Of a person's few scans. Without muscles that act by themselves no floor does as well: by the
# flesh's linear response 79 markers left 0.88 mm (0.3) and 1.03 mm (0.6), these leave 0.83 mm.
OF_SCANS = PriorOptions(own_strength=0.5, known="scans")
LOOSE = PriorOptions(known="nothing")


@dataclass(frozen=True)
class GaussianPrior:
    """-log of N(mean, covariance) over the controls q (k,), but for a constant.

    ``shapes`` (e, v, 3) are the motions of the whole skin, mm, of the template's expressions that
    it is of.
    """

    mean: Floats
    covariance: Floats  # (k, k)
    shapes: NDArray[np.floating] | None = None

    @cached_property
    def precision(self) -> Floats:
        """Return the inverse of the covariance."""
        return inverse_of_positive(self.covariance)

    @property
    def variance(self) -> Floats:
        """Return the variance (k,) of each control."""
        return np.diag(self.covariance)

    def value(self, pose: Pose) -> float:
        """See :class:`~solver.fitting.objective.Prior`."""
        away = pose.vector() - self.mean
        return float(0.5 * away @ self.precision @ away)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`~solver.fitting.objective.Prior`."""
        return np.asarray(self.precision @ (pose.vector() - self.mean))

    def gauss_newton(self, pose: Pose) -> Floats:  # noqa: ARG002 - it is the same everywhere
        """See :class:`~solver.fitting.objective.Prior`."""
        return self.precision

    def about(self, mean: Floats) -> GaussianPrior:
        """Return the same distribution about another mean (k,)."""
        found = replace(self, mean=mean)
        vars(found)["precision"] = self.precision  # is not inverted again
        return found

    def after(self, mean: Floats, covariance: Floats, seconds: float, time: float) -> GaussianPrior:
        """Return the prior so long after a frame whose posterior was N(mean, covariance)."""
        kept = kept_part(seconds, time)
        spread = kept**2 * covariance + (1.0 - kept**2) * self.covariance
        return GaussianPrior(self.faded(mean, kept), spread)

    def faded(self, mean: Floats, kept: float) -> Floats:
        """Return a mean (k,) of which a part is ``kept`` on its way back to rest."""
        return np.asarray(self.mean + kept * (mean - self.mean))


def kept_part(seconds: float, time: float) -> float:
    """Return the part of a control that is left so long after a frame, as it fades to rest."""
    return float(np.exp(-seconds / time))


@dataclass(frozen=True)
class PartPrior:
    """-log of N(mean, P^-1) over some entries of the controls (size,), but for a constant."""

    size: int
    places: Ints  # (j,) of the entries
    mean: Floats  # (j,)
    precision: Floats  # P (j, j)

    def value(self, pose: Pose) -> float:
        """See :class:`~solver.fitting.objective.Prior`."""
        away = pose.vector()[self.places] - self.mean
        return float(0.5 * away @ self.precision @ away)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`~solver.fitting.objective.Prior`."""
        out = np.zeros(self.size)
        out[self.places] = self.precision @ (pose.vector()[self.places] - self.mean)
        return out

    def gauss_newton(self, pose: Pose) -> Floats:  # noqa: ARG002 - it is the same everywhere
        """See :class:`~solver.fitting.objective.Prior`."""
        out = np.zeros((self.size, self.size))
        out[np.ix_(self.places, self.places)] = self.precision
        return out


@dataclass(frozen=True)
class PriorSum:
    """The sum of priors."""

    priors: tuple[Prior, ...]

    def value(self, pose: Pose) -> float:
        """See :class:`~solver.fitting.objective.Prior`."""
        return sum(prior.value(pose) for prior in self.priors)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`~solver.fitting.objective.Prior`."""
        return np.asarray(sum(prior.gradient(pose) for prior in self.priors))

    def gauss_newton(self, pose: Pose) -> Floats:
        """See :class:`~solver.fitting.objective.Prior`."""
        first, *others = (prior.gauss_newton(pose) for prior in self.priors)
        out = first.copy()
        for other in others:
            out += other
        return out


def from_changes(
    layout: Layout, changes: Iterable[Floats], options: PriorOptions = PriorOptions()
) -> GaussianPrior:
    """Return the prior of expressions, changes (k,) of the controls off the rest."""
    known = np.reshape([*changes], (-1, layout.size))
    own = np.zeros((layout.size, layout.size))
    for part in (*layout.muscles, *(layout.places(joint.name) for joint in layout.joints)):
        own[np.ix_(part, part)] = known[:, part].T @ known[:, part]
    floor = layout.spread(options.known)
    spread = options.strength**2 * known.T @ known + options.own_strength**2 * own
    return GaussianPrior(layout.rest, spread + np.diag(floor**2))


def from_expressions(face: Face, poses: Iterable[Pose]) -> GaussianPrior:
    """Return the prior of a person's fitted expressions alone."""
    rest = face.layout.rest
    return from_changes(face.layout, [pose.vector() - rest for pose in poses], OF_SCANS)


def from_shapes(
    face: Face, shapes: NDArray[np.floating], options: PriorOptions = PriorOptions()
) -> GaussianPrior:
    """Return the prior of a template's expressions, motions (e, v, 3) of the whole skin, mm.

    A shape's change of the controls is the regularised least squares of the face's points; and,
    of a jaw on tracks, of the lower teeth. A free jaw follows the skin alone: it has the freedom
    to make up for flesh that moves otherwise than the shapes.
    """
    known = from_changes(face.layout, _linear_changes(face, shapes), options)
    return replace(known, shapes=shapes)


def from_fitted_shapes(
    face: Face,
    shapes: NDArray[np.floating],
    options: PriorOptions = PriorOptions(),
    listen: Callable[[float], None] = lambda _done: None,
) -> GaussianPrior:
    """Return the prior of :func:`from_shapes`, large shapes being fitted as expressions are.

    The linear response at rest errs where flesh moves far: with it 79 markers left 1.12 mm on wide
    open mouths, with fits 0.96 mm. A fit takes a second; ``listen`` gets the part that is done. A
    shape that cannot be fitted keeps its linear response.
    """
    changes = np.vstack(fitted_changes(face, shapes, options, listen))
    return replace(from_changes(face.layout, changes, options), shapes=shapes)


def fitted_changes(
    face: Face,
    shapes: NDArray[np.floating],
    options: PriorOptions = PriorOptions(),
    listen: Callable[[float], None] = lambda _done: None,
) -> list[Floats]:
    """Return for each shape the changes (j, k) of the controls that fits to parts of it give.

    The greatest part comes last. Small shapes, and those that cannot be fitted, have one row: their
    linear response.
    """
    linear = _linear_changes(face, shapes)
    changes = [each[None] for each in linear]
    large = np.flatnonzero(_mean_motion(face, shapes) > options.large_mm)
    parts = options.parts_on_tracks if follows_teeth(face) else options.fitted_parts
    for count, number in enumerate(large.tolist()):
        fitted = []
        for part in parts:
            with suppress(SolveError):
                fitted.append(_fitted_change(face, shapes[number], linear[number], part, options))
        if fitted:
            changes[number] = np.array(fitted)
        listen((count + 1) / len(large))
    return changes


def _mean_motion(face: Face, shapes: NDArray[np.floating]) -> Floats:
    return np.asarray(np.linalg.norm(shapes[:, face.model.face], axis=2).mean(axis=1))


def follows_teeth(face: Face) -> bool:
    """Tell whether shapes' teeth say where the jaw is, which their skin does of a free one."""
    return len(face.model.lower_teeth) > 0 and not face.joint.is_free


def jaw_of_teeth(
    face: Face, teeth: Floats, goal: Floats, start: Floats, inner: Floats | None = None
) -> tuple[Ints, Floats]:
    """Return where the jaw stands among the controls, and what carries ``teeth`` to a ``goal``.

    The arguments are those of :func:`nearest_jaw`; the numbers are within the jaw's bounds.
    """
    places = face.layout.places(face.joint.block.name)
    bounds = face.joint.block.lower, face.joint.block.upper
    return places, nearest_jaw(face.jaw, teeth, goal, start, inner=inner, bounds=bounds)


def _linear_changes(face: Face, shapes: NDArray[np.floating]) -> Floats:
    """Return the changes (e, k) of the controls that make the shapes, to first order at rest."""
    jacobian = Sensitivity(face, face.rest).by_pose()
    hessian = rest_curvature(face) + unseen_regulariser(face).gauss_newton(face.rest.pose)
    moved = np.asarray(shapes[:, face.model.face], np.float64) * (2.0 / len(face.model.face))
    pulls = np.array([jacobian.adjoint(face.face_embedding.T @ shape) for shape in moved])
    if follows_teeth(face):
        teeth = face.model.lower_teeth
        rows, part = _teeth_by_controls(face), 2.0 / len(teeth)
        hessian += part * (rows.T @ rows)
        pulls += part * (shapes[:, teeth].reshape(len(shapes), -1) @ rows)
    return np.asarray(scipy.linalg.solve(hessian, pulls.T, assume_a="pos").T)


def _fitted_change(
    face: Face, shape: NDArray[np.floating], change: Floats, part: float, options: PriorOptions
) -> Floats:
    """Return the change (k,) of a fit to ``part`` of a shape, which ``change`` makes about."""
    points, rest = face.model.face, face.model.skin.vertices
    goal = rest + part * np.asarray(shape, np.float64)
    near = face.rest_pose().add(options.fitted_from * part * change)
    regulariser: Prior = unseen_regulariser(face)
    if follows_teeth(face):
        teeth, jaw = face.model.lower_teeth, face.joint.block
        places, b = jaw_of_teeth(face, rest[teeth], goal[teeth], near.b)
        near = replace(near, b=b)
        weights = np.diag(options.held * np.broadcast_to(jaw.units, b.shape) ** 2)
        regulariser = PriorSum((regulariser, PartPrior(face.layout.size, places, b, weights)))
    start, effort = face.continuation(face.rest, near), options.effort
    distance = SkinDistance(face, Target.from_points(goal[points]))
    found = fit(face, distance, regulariser, start, effort)
    return np.asarray((found.state.pose.vector() - face.layout.rest) / part)


def _teeth_by_controls(face: Face) -> Floats:
    """Return the derivative (3 n, k) of the lower teeth at rest by the controls."""
    layout, teeth = face.layout, face.model.lower_teeth
    rows = np.zeros((3 * len(teeth), layout.size))
    by_jaw = face.jaw.jacobian(face.model.skin.vertices[teeth], face.rest_pose().b)
    rows[:, layout.places(face.joint.block.name)] = by_jaw.reshape(len(rows), -1)
    return rows
