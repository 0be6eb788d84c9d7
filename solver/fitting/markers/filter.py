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
from solver.fitting.known import KnownTerm
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
    """The normal matrix (q, q) of a frame's markers and table, and the posterior by them alone.

    ``table`` is the term of what is known of muscles, ``usual`` the prior of any such frame.
    """

    normal: Floats
    alone: Posterior
    usual: GaussianPrior
    table: KnownTerm | None = None


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
        self.usual = usual
        self._seconds = seconds
        self._options = options
        self._kept = kept_part(seconds, options.forgetting)
        self.begin()

    def begin(self) -> None:
        """Drop what was steady: a resumed take goes on as one that never stopped."""
        self._last: _Frame | None = None
        self._is_steady = False

    def evidence(self, normal: Floats, table: KnownTerm | None = None) -> Evidence:
        """Return what markers of a ``normal`` matrix (q, q) and a table tell by themselves."""
        usual = with_room(self.usual, table)
        whole = normal if table is None else normal + table.curvature
        covariance = inverse_of_positive(usual.precision + whole)
        return Evidence(whole, Posterior(covariance, self.usual.variance), usual, table)

    def later(
        self, mean: Floats, covariance: Floats, table: KnownTerm | None = None
    ) -> GaussianPrior:
        """Return what is probable of a frame with a ``table`` after one with this posterior."""
        found = self.usual.after(mean, covariance, self._seconds, self._options.forgetting)
        return with_room(found, table)

    def before(
        self, mean: Floats, known: KnownControls, table: KnownTerm | None = None
    ) -> GaussianPrior:
        """Return the prior of the frame after one with this mean (q,), a steady one again."""
        last = self._last
        is_same = last is not None and is_of_same(table, last.evidence.table)
        if self._is_steady and last is not None and known is last.known and is_same:
            return last.prior.about(self.usual.fade(mean, self._kept))
        return self.later(mean, known.covariance, table)

    def after(
        self, prior: GaussianPrior, known: KnownControls | None, evidence: Evidence
    ) -> KnownControls:
        """Return what is known after a frame: ``prior`` is :meth:`before` of it, from ``known``.

        ``known`` is None before the first frame.
        """
        last = self._last
        if last is None or known is not last.known or evidence is not last.evidence:
            self._is_steady = False
        elif self._is_steady:
            return known
        sure = prior
        if known is not None:
            sure = self.later(prior.mean, known.spread, evidence.table)
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
        usual = evidence.usual.precision
        unseen = 1.0 - evidence.alone.information
        before = unseen[:, None] * (prior.precision - usual) * unseen
        return inverse_of_positive(usual + before + evidence.normal)

    @staticmethod
    def _change(known: KnownControls, found: KnownControls) -> float:
        """Return the greatest relative change of a variance."""
        pairs = ((known.covariance, found.covariance), (known.spread, found.spread))
        return max(float(np.abs(np.diag(b) / np.diag(a) - 1.0).max()) for a, b in pairs)


def with_room(prior: GaussianPrior, table: KnownTerm | None) -> GaussianPrior:
    """Return a prior with room for what the muscles of a table do by themselves."""
    if table is None:
        return prior
    return GaussianPrior(prior.mean, prior.covariance + table.freedom, prior.shapes)


def is_of_same(table: KnownTerm | None, other: KnownTerm | None) -> bool:
    """Tell whether two tables hold values of the same muscles."""
    if table is None or other is None:
        return table is other
    return np.array_equal(table.rates, other.rates)
