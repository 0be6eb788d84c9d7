"""Carry from frame to frame how well the controls are known: covariances of a Kalman filter.

    Q = c^2 P + (1 - c^2) C,    P' = (Q^-1 + N)^-1

Q is the covariance before a frame and P' that after it, C the prior's, c the part of a control that
is left (:meth:`GaussianPrior.after`), N the normal matrix of the frame's markers. While these are
weighed alike and derivatives lag, N stays, and P comes to the steady state of this recursion, which
is used again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting.information import Posterior, inverse_of_positive
from solver.fitting.prior import GaussianPrior, kept_part
from solver.surface import Floats


@dataclass(frozen=True)
class FilterOptions:
    """Numbers of the filter."""

    forgetting: float = 1.0  # s in which a control that no marker determines fades to 1/e
    # change of a variance in a frame up to which it counts as steady, as a part of what forgetting
    # takes from it there: by half of that the standard deviation may still be off
    steady: float = 0.05


@dataclass(frozen=True)
class Evidence:
    """The normal matrix (q, q) of a frame's markers, and the posterior by them alone."""

    normal: Floats
    alone: Posterior


@dataclass(frozen=True)
class KnownControls:
    """Covariances (q, q) of the controls after a frame.

    ``covariance`` is the filter's, points of all frames being independent; ``spread`` is as surely
    as the controls are known: see :meth:`ControlFilter.spread`.
    """

    covariance: Floats
    spread: Floats


@dataclass(frozen=True)
class _Frame:
    """The last frame: its prior, its evidence and what is known after it."""

    prior: GaussianPrior
    evidence: Evidence
    known: KnownControls


class ControlFilter:
    """Carries covariances over frames that are ``seconds`` apart; ``usual`` is any pose's prior."""

    def __init__(
        self, usual: GaussianPrior, seconds: float, options: FilterOptions = FilterOptions()
    ) -> None:
        self.usual, self._seconds, self._options = usual, seconds, options
        self._kept = kept_part(seconds, options.forgetting)
        self.begin()

    def begin(self) -> None:
        """Drop what was steady: a resumed take goes on as one that never stopped."""
        self._last: _Frame | None = None
        self._is_steady = False

    def evidence(self, normal: Floats) -> Evidence:
        """Return what markers of a ``normal`` matrix (q, q) tell by themselves."""
        covariance = inverse_of_positive(self.usual.precision + normal)
        return Evidence(normal, Posterior(covariance, self.usual.variance))

    def later(self, mean: Floats, covariance: Floats) -> GaussianPrior:
        """Return what is probable of a frame after one with this posterior."""
        return self.usual.after(mean, covariance, self._seconds, self._options.forgetting)

    def before(self, mean: Floats, known: KnownControls) -> GaussianPrior:
        """Return the prior of the frame after one with this mean (q,), a steady one again."""
        if self._is_steady and self._last is not None and known is self._last.known:
            return self._last.prior.about(self.usual.faded(mean, self._kept))
        return self.later(mean, known.covariance)

    def after(
        self, prior: GaussianPrior, known: KnownControls | None, evidence: Evidence
    ) -> KnownControls:
        """Return what is known after a frame: ``prior`` is :meth:`before` of it, from ``known``.

        That is None before the first frame.
        """
        last = self._last
        if last is None or known is not last.known or evidence is not last.evidence:
            self._is_steady = False
        elif self._is_steady:
            return known
        sure = prior if known is None else self.later(prior.mean, known.spread)
        found = KnownControls(
            inverse_of_positive(prior.precision + evidence.normal), self.spread(sure, evidence)
        )
        if last is not None and evidence is last.evidence and known is last.known:
            forgotten = 1.0 - self._kept**2
            self._is_steady = self._change(known, found) <= self._options.steady * forgotten
        self._last = _Frame(prior, evidence, found)
        return found

    def spread(self, prior: GaussianPrior, evidence: Evidence) -> Floats:
        """Return the covariance (q, q) of a frame's controls; ``prior`` is that before it.

        Frames before make nothing surer that this one determines: markers bound beside where they
        are err alike in all of them, and many such frames are worth no more than one. The filter
        goes on from its own, smaller covariance: it follows a bias as closely, and is less stirred
        by noise.
        """
        usual, unseen = self.usual.precision, 1.0 - evidence.alone.information
        before = unseen[:, None] * (prior.precision - usual) * unseen
        return inverse_of_positive(usual + before + evidence.normal)

    @staticmethod
    def _change(known: KnownControls, found: KnownControls) -> float:
        """Return the greatest relative change of a variance."""
        pairs = ((known.covariance, found.covariance), (known.spread, found.spread))
        return max(float(np.abs(np.diag(b) / np.diag(a) - 1.0).max()) for a, b in pairs)
