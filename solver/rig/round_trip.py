"""Round trip of a fit: its activations simulated from rest, and fitted again to what that gives.

The first half shows whether the pose has another equilibrium than the one that was fitted
(buckling), the second whether the skin tells the activations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from solver.errors import SolveError
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.stretches import FROBENIUS
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats


@dataclass(frozen=True)
class RoundTripOptions:
    """Weights of the second fit, and the muscles that are compared.

    The regularisers are light: the target can be reached, and a bias would be taken for an error.
    """

    excited: float = 0.05  # a muscle this far from rest (Frobenius) counts as excited
    w_a: float = 1e-5
    w_v: float = 1e-3
    w_b: float = 1e-7
    stop: ActivationOptions = field(default_factory=lambda: ActivationOptions(25, tolerance=1e-2))


@dataclass(frozen=True)
class RoundTrip:
    """Figures of what came back; NaN where a pose cannot be reached from rest or fitted again."""

    skin_mean_mm: float = np.nan  # between the fitted and the simulated skin, over the face
    skin_max_mm: float = np.nan
    refit_mean_mm: float = np.nan  # between the simulated and the fitted-again skin
    refit_max_mm: float = np.nan
    activation_error: float = np.nan  # NaN too if no muscle is excited

    @property
    def is_reached(self) -> bool:
        """Return whether the pose was reached from rest."""
        return bool(np.isfinite(self.skin_mean_mm))

    @classmethod
    def between(cls, simulated: Floats, fitted: Floats) -> RoundTrip:
        """Return how far the face (k, 3) lies off the fitted one, mm, where it was simulated."""
        apart = np.linalg.norm(simulated - fitted, axis=1)
        return cls(float(apart.mean()), float(apart.max()))


def round_trip(
    face: Face, pose: Pose, fitted_face: Floats, options: RoundTripOptions = RoundTripOptions()
) -> RoundTrip:
    """Simulate ``pose`` from rest, and fit it again; ``fitted_face`` (k, 3) is its skin in mm.

    The pose has a free jaw, the fit the jaw of ``face``.
    """
    free = face.with_free_jaw()
    try:
        simulated = free.continuation(free.rest, pose)
    except SolveError:
        return RoundTrip()
    points = face.face_points(simulated.x)
    there = RoundTrip.between(points, fitted_face)
    regulariser = Regulariser(options.w_a, options.w_v, options.w_b, prior=face.rest_pose())
    data = SkinDistance(face, Target.from_points(points))
    try:
        again = activation.fit(face, data, regulariser, options=options.stop).state
    except (SolveError, np.linalg.LinAlgError):
        return there
    left = np.linalg.norm(face.face_points(again.x) - points, axis=1)
    return replace(
        there,
        refit_mean_mm=float(left.mean()),
        refit_max_mm=float(left.max()),
        activation_error=activation_error(
            pose.a, again.pose.a, options.excited, pose.layout.drive.rest
        ),
    )


def activation_error(
    a: Floats, found: Floats, excited_from: float = 0.05, rest: Floats = IDENTITY
) -> float:
    """Return |found - a| by |a - rest| over the excited muscles of ``a``; NaN without any.

    Muscles are of six numbers, (m, 6), or of one, (m,).
    """
    strength = _sizes(a - rest)
    excited = strength > excited_from
    if not excited.any():
        return float("nan")
    missed = _sizes(found - a)
    return float(np.linalg.norm(missed[excited]) / np.linalg.norm(strength[excited]))


def _sizes(changes: Floats) -> Floats:
    """Return the size (m,) of every muscle's change, as a matrix' if it is of six numbers."""
    if changes.ndim == 1:
        return np.abs(changes)
    return np.asarray(np.sqrt(changes**2 @ FROBENIUS))
