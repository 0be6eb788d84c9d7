"""Keep the muscles that close the jaw silent while it is open.

Masseter, temporalis and medial pterygoid lengthen as the jaw opens: who opens it lets them go, but
for some co-contraction. In the fit the contraction k_j of each of them pays

    w/2 (t(o) max(0, k_j - cocontraction))^2,

o being how far the jaw is open, mm, and t(o) = 3 s^2 - 2 s^3 with s going from 0 to 1 as o goes
from ``ajar_mm`` to ``open_mm``. So it is tied to the pose of the jaw, whatever a scan calls for:
the fit may close the jaw as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from typing_extensions import override

from solver.anatomy.action_units import action_units, is_one_of
from solver.fitting.face import Face, Pose
from solver.fitting.objective import SquaredPrior
from solver.mechanics.boundary import JawMotion
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class CloserOptions:
    """Limits of what the closers of the jaw may do while it is open.

    Masseter has EMG while a jaw opens and closes freely (van Eijden, Blanksma and Brugman, Journal
    of Dental Research 72, 1993, 599-606). No source has that as a shortening: the number is ours.
    """

    cocontraction: float = 0.03  # part of their length by which they contract for nothing
    ajar_mm: float = 2.0  # between the incisors, up to which the jaw is closed
    open_mm: float = 5.0  # from which it is open
    price: float = 1e4  # of what they contract beyond, squared, by w_a
    closed_by: str = "AU 27"  # the unit whose antagonists they are


@dataclass(frozen=True, eq=False)
class SilentClosers(SquaredPrior):
    """The price of k closers' contraction.

    ``numbers`` (k,) are those of the muscles, ``places`` (k, 6) are those of their activations
    among the controls, ``rates`` (k, 6) the derivatives of their contractions; ``joint`` are the
    places of the jaw's numbers. ``front`` (1, 3) is the point at which a jaw opens, mm, ``down``
    (3,) the way it goes.
    """

    numbers: Ints
    places: Ints
    rates: Floats
    joint: Ints
    motion: JawMotion
    front: Floats
    down: Floats
    options: CloserOptions
    weight: float

    @classmethod
    def of_face(cls, face: Face, options: CloserOptions = CloserOptions()) -> SilentClosers:
        """Make the price of a face's muscles that close the jaw; none pays without fibres."""
        model = face.model
        closers = action_units()[options.closed_by].antagonists
        found = face.contractions
        rates = np.full(face.layout.muscles.shape, np.nan) if found is None else found.rates
        named = np.array([is_one_of(name, closers) for name in model.muscle_names], dtype=bool)
        numbers = np.flatnonzero(named & np.isfinite(rates).all(axis=1))
        return cls(
            numbers,
            face.layout.muscles[numbers],
            rates[numbers],
            face.layout.joint_places,
            face.jaw,
            model.jaw_front,
            -model.jaw.axes[1],
            options,
            options.price,
        )

    def without(self, muscles: Ints) -> SilentClosers:
        """Return the price of those that are none of ``muscles`` (k,)."""
        kept = ~np.isin(self.numbers, muscles)
        return replace(
            self, numbers=self.numbers[kept], places=self.places[kept], rates=self.rates[kept]
        )

    @override
    def residuals(self, pose: Pose) -> Floats:
        return self._open(pose)[0] * self._beyond(pose)

    @override
    def gradient(self, pose: Pose) -> Floats:
        out = np.zeros(pose.layout.size)
        left, slopes, used = self._linear(pose)
        out[used] = self.weight * left @ slopes
        return out

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        _, slopes, used = self._linear(pose)
        out[np.ix_(used, used)] += self.weight * slopes.T @ slopes

    def _linear(self, pose: Pose) -> tuple[Floats, Floats, Ints]:
        """Return the residuals t(o) max(0, ...) (k,), and their derivatives (k, u) by u controls.

        The last are the places of these (u,).
        """
        (part, by_jaw), beyond = self._open(pose), self._beyond(pose)
        contracting = np.flatnonzero(part * beyond > 0.0)
        own = self.places[contracting]
        slopes = np.zeros((len(self.numbers), own.size + len(self.joint)))
        columns = np.arange(own.size).reshape(own.shape)
        slopes[contracting[:, None], columns] = part * self.rates[contracting]
        slopes[:, own.size :] = beyond[:, None] * by_jaw
        return part * beyond, slopes, np.concatenate([own.ravel(), self.joint])

    def _beyond(self, pose: Pose) -> Floats:
        change = pose.a.reshape(len(pose.a), -1)[self.numbers] - IDENTITY
        found = (self.rates * change).sum(axis=1)
        return np.asarray(np.maximum(found - self.options.cocontraction, 0.0))

    def _open(self, pose: Pose) -> tuple[float, Floats]:
        """Return t(o), and its derivative by the jaw's numbers."""
        shut = self.options.ajar_mm
        wide = self.options.open_mm
        opening = float((self.motion.move(self.front, pose.b) - self.front)[0] @ self.down)
        s = float(np.clip((opening - shut) / (wide - shut), 0.0, 1.0))
        by_jaw = self.down @ self.motion.jacobian(self.front, pose.b)[0]
        return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / (wide - shut) * by_jaw
