"""Where markers are expected before a frame, and where once some of its points are known.

    p ~ N(points, H C H^T),    o_k = p_k + e_k,    e_k ~ N(0, Lambda_k^-1)

C is the covariance of controls and head, H the derivative of the places by them. With more controls
than rows, as in fits of takes, the covariance of the places is at hand
(:class:`PredictedPlaces`); with fewer, as where a few sliders are followed, a posterior costs a
matrix of their number: (C^-1 + H^T Lambda H)^-1 (:class:`RatedPlaces`). Both say the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
import scipy.linalg
from typing_extensions import override

from solver.fitting.information import inverse_of_positive, solve_positive
from solver.fitting.markers.term import HeadPrior, head_rates
from solver.surface import Floats, Ints


class Prediction(Protocol):
    """A normal distribution of markers' places in the take."""

    points: Floats  # (k, 3) mm, the most probable

    def condition(self, seen: Floats, precision: Floats) -> Self:
        """Return the places given points ``seen`` (k, 3) of ``precision`` (k, 3), 0 for none."""

    def conditional_mean(self, seen: Floats, precision: Floats) -> Floats:
        """Return the places (k, 3) of :meth:`condition`, without their covariance."""

    @property
    def sd(self) -> Floats:
        """Return the greatest of a marker's three standard deviations, (k,) mm."""


@dataclass(frozen=True)
class PredictedPlaces(Prediction):
    """Places ``points`` (k, 3) with their ``covariance`` (3 k, 3 k)."""

    points: Floats
    covariance: Floats

    @classmethod
    def of(cls, head: HeadPrior, centre: Floats, places: Floats, spread: Floats) -> PredictedPlaces:
        """Return where markers at ``places`` (k, 3) in the head's frame are seen.

        ``spread`` (3 k, 3 k) is the covariance of the places in the head's frame, ``centre`` (3,)
        what the head's motion is counted about.
        """
        points = head.motion(places)
        rotation = head.motion.rotation
        # every block of three rows, then every block of three columns
        turned = (rotation @ spread.reshape(len(places), 3, -1)).reshape(-1, 3) @ rotation.T
        by_head = head_rates(points - head.motion(centre[None]))
        covariance = turned.reshape(spread.shape)
        covariance += by_head @ np.linalg.solve(head.precision, by_head.T)
        return cls(points, covariance)

    @override
    def condition(self, seen: Floats, precision: Floats) -> PredictedPlaces:
        rows = np.flatnonzero(precision.ravel() > 0.0)
        gain, spread = self._gain(rows, precision)
        scaled = scipy.linalg.solve(spread, gain.T, assume_a="pos") if len(rows) else gain.T
        step = (seen - self.points).ravel()[rows] @ scaled
        return PredictedPlaces(self.points + step.reshape(-1, 3), self.covariance - gain @ scaled)

    @override
    def conditional_mean(self, seen: Floats, precision: Floats) -> Floats:
        rows = np.flatnonzero(precision.ravel() > 0.0)
        if not len(rows):
            return self.points
        gain, spread = self._gain(rows, precision)
        off = (seen - self.points).ravel()[rows]
        factor = scipy.linalg.cho_factor(spread, overwrite_a=True, check_finite=False)
        step = gain @ scipy.linalg.cho_solve(factor, off, check_finite=False)
        return np.asarray(self.points + step.reshape(-1, 3))

    def _gain(self, rows: Ints, precision: Floats) -> tuple[Floats, Floats]:
        """Return the columns ``rows`` of the covariance, and that of what is seen there."""
        everything = len(rows) == len(self.covariance)  # is not gathered
        gain = self.covariance if everything else self.covariance[:, rows]
        spread = gain.copy() if everything else gain[rows]
        spread[np.diag_indices_from(spread)] += 1.0 / precision.ravel()[rows]
        return gain, spread

    @property
    @override
    def sd(self) -> Floats:
        count = len(self.points)
        return _greatest_sd(
            self.covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
        )


@dataclass(frozen=True)
class RatedPlaces(Prediction):
    """Places ``points`` (k, 3) with their ``rates`` (3 k, q), and the ``precision`` (q, q)."""

    points: Floats
    rates: Floats
    precision: Floats  # C^-1

    @classmethod
    def of(
        cls, head: HeadPrior, centre: Floats, places: Floats, jacobian: Floats, precision: Floats
    ) -> RatedPlaces:
        """Return where markers at ``places`` (k, 3) in the head's frame are seen.

        ``jacobian`` (3 k, s) is their derivative by controls of a ``precision`` (s, s), ``centre``
        (3,) what the head's motion is counted about.
        """
        points = head.motion(places)
        count = jacobian.shape[1]
        rates = np.empty((len(jacobian), count + 6))
        turned = head.motion.rotation @ jacobian.reshape(len(places), 3, -1)
        rates[:, :count] = turned.reshape(jacobian.shape)
        rates[:, count:] = head_rates(points - head.motion(centre[None]))
        return cls(points, rates, scipy.linalg.block_diag(precision, head.precision))

    @override
    def condition(self, seen: Floats, precision: Floats) -> RatedPlaces:
        normal, slope = self._pulled(seen, precision)
        step = self.rates @ solve_positive(normal, slope)
        return RatedPlaces(self.points + step.reshape(-1, 3), self.rates, normal)

    @override
    def conditional_mean(self, seen: Floats, precision: Floats) -> Floats:
        step = self.rates @ solve_positive(*self._pulled(seen, precision))
        return np.asarray(self.points + step.reshape(-1, 3))

    def _pulled(self, seen: Floats, precision: Floats) -> tuple[Floats, Floats]:
        """Return the precision (q, q) of controls and head given points, and their pull (q,)."""
        weighted = self.rates * precision.reshape(-1, 1)
        normal = self.rates.T @ weighted
        normal += self.precision
        return normal, weighted.T @ (seen - self.points).ravel()

    @property
    @override
    def sd(self) -> Floats:
        rates = self.rates.reshape(len(self.points), 3, -1)
        spread = (self.rates @ inverse_of_positive(self.precision)).reshape(rates.shape)
        return _greatest_sd(spread @ np.swapaxes(rates, 1, 2))


def _greatest_sd(covariances: Floats) -> Floats:
    """Return the greatest standard deviation (k,) of each of ``covariances`` (k, 3, 3)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariances)[:, -1]))
