"""Posterior covariance and information of the controls of a linear Gaussian model.

    y = J q + e,    e ~ N(0, diag(sd^2)),    q ~ N(mean, P^-1)

The covariance of q after y is C = (P + J^T diag(sd^-2) J)^-1, whatever y is: so what a set of
markers or scans would determine is known before any is taken. The information of an entry of q is
1 - C_jj / (P^-1)_jj: 0 where the data leave it as uncertain as the prior, 1 where they determine it
(the averaging kernel's diagonal, Rodgers 2000, chapter 2). Further rows A with noise R take

    C A^T (A C A^T + R)^-1 A C

from C, so that a candidate costs a small matrix and not another inverse.

All of it is conditioned on what J was made with. For fits of a face that is the muscle geometry S,
the flesh's law and the state of linearisation, none of which is exact: the spreads are those of
controls under the S at hand, and too small by the errors of S. The information of S itself is
:mod:`solver.fitting.geometry_information`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.linalg

from solver.errors import SolveError
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Posterior:
    """Covariance (k, k) of q given data, beside its variances (k,) before them."""

    covariance: Floats
    prior_variance: Floats

    @classmethod
    def of(cls, jacobian: Floats, sd: Floats | float, precision: Floats) -> Posterior:
        """Return the posterior of a prior and rows ``jacobian`` (r, k) of noise ``sd`` (r,).

        ``precision`` (k, k) is the prior's, positive definite. A row with an infinite sd adds
        nothing. Raises :class:`SolveError` (``solve.not_finite``) where there is no covariance.
        """
        rows = jacobian / np.broadcast_to(sd, len(jacobian))[:, None]
        return cls.of_normal(rows.T @ rows, precision)

    @classmethod
    def of_normal(cls, normal: Floats | float, precision: Floats) -> Posterior:
        """Return the same for the data's ``normal`` matrix J^T diag(sd^-2) J, (k, k)."""
        prior = inverse_of_positive(precision)
        return cls(inverse_of_positive(precision + normal), np.diag(prior).copy())

    @property
    def sd(self) -> Floats:
        """Return the standard deviations (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def information(self) -> Floats:
        """Return 1 - posterior / prior variance, (k,) in [0, 1]."""
        return np.clip(1.0 - np.diag(self.covariance) / self.prior_variance, 0.0, 1.0)

    def information_of(self, places: Ints) -> Floats:
        """Return the information (...) of groups of entries ``places`` (..., g).

        It is the part of a group's prior variance that the data take away.
        """
        after = np.diag(self.covariance)[places].sum(axis=-1)
        return np.asarray(np.clip(1.0 - after / self.prior_variance[places].sum(axis=-1), 0.0, 1.0))

    @property
    def correlation(self) -> Floats:
        """Return the correlation (k, k) of every pair: near -1 or 1 it cannot be told apart."""
        sd = self.sd
        return np.asarray(self.covariance / np.outer(sd, sd))

    def correlated_pairs(self, least: float = 0.8) -> list[tuple[int, int, float]]:
        """Return the pairs i < j whose correlation is ``least`` or more, and it, worst first."""
        correlation = np.triu(self.correlation, 1)
        pairs = np.argwhere(np.abs(correlation) >= least)
        found = [(int(i), int(j), float(correlation[i, j])) for i, j in pairs]
        return sorted(found, key=lambda pair: -abs(pair[2]))

    def after(self, normal: Floats) -> Posterior:
        """Return the posterior after further data of the ``normal`` matrix (k, k), of any rank."""
        both = np.eye(len(normal)) + normal @ self.covariance
        found = self.covariance @ np.linalg.inv(both)
        return Posterior(0.5 * (found + found.T), self.prior_variance)

    def greedy(
        self, candidates: Floats, count: int, sd: Floats | float = 1.0
    ) -> list[tuple[int, float]]:
        """Choose ``count`` of ``candidates`` (c, d, k), each where it helps most beside the others.

        A candidate is d rows, the three coordinates of a marker for one, of noise ``sd`` (d,) or
        (c, d). Returns their numbers and gains of information: the sum over the controls of the
        variance that they take away, by that of the prior. A chosen one may be chosen again: that
        is a second, independent look at the same place.
        """
        now = self
        covariances = candidates @ self.covariance
        chosen = []
        each = np.broadcast_to(sd, candidates.shape[:2])
        for _ in range(count):
            taken = (covariances / now.prior_variance) @ np.swapaxes(covariances, -1, -2)
            spread = _prediction_spread(covariances, candidates, each)
            gains = np.trace(np.linalg.solve(spread, taken), axis1=-2, axis2=-1)
            best = int(gains.argmax())
            chosen.append((best, float(gains[best])))
            rows = covariances[best]
            gain = np.linalg.solve(_prediction_spread(rows, candidates[best], each[best]), rows)
            covariances = covariances - (candidates @ rows.T) @ gain
            now = Posterior(now.covariance - rows.T @ gain, now.prior_variance)
        return chosen


def _prediction_spread(covariances: Floats, rows: Floats, sd: Floats | float) -> Floats:
    """Return the spread A C A^T + R of what rows A (..., d, k) predict; ``covariances`` is A C."""
    spread = covariances @ np.swapaxes(rows, -1, -2)
    each = np.arange(rows.shape[-2])
    spread[..., each, each] += np.square(sd)
    return spread


def inverse_of_positive(matrix: Floats) -> Floats:
    """Return the inverse of a symmetric positive definite matrix, exactly symmetric.

    Raises :class:`SolveError` (``solve.not_finite``) for any other.
    """
    # entries differ in unit and so in size by orders: scaled to a unit diagonal first
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1.0 / np.sqrt(np.diag(matrix))
        scaled = np.multiply(matrix, scale, order="F")
        scaled *= scale[:, None]
    factor, failed = scipy.linalg.lapack.dpotrf(scaled, lower=1, overwrite_a=1, clean=0)
    if failed or not np.isfinite(np.diag(factor)).all():
        message = "no posterior: the precision is not positive definite"
        raise SolveError("solve.not_finite", message)
    inverse, _ = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    inverse *= scale
    inverse *= scale[:, None]
    above = _above(len(matrix))
    inverse[above] = inverse.T[above]
    return np.asarray(inverse)


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Return x (k,) or (k, r) of matrix x = right for a symmetric positive definite matrix (k, k).

    Raises :class:`SolveError` (``solve.not_finite``) for any other.
    """
    _, found, failed = scipy.linalg.lapack.dposv(matrix.T, right, lower=1, overwrite_a=0)
    if failed or not np.isfinite(found).all():
        message = "no step: the normal matrix is not positive definite"
        raise SolveError("solve.not_finite", message)
    return np.asarray(found)


@cache
def _above(size: int) -> tuple[Ints, Ints]:
    """Return the rows and columns above the diagonal of a square matrix."""
    rows, columns = np.triu_indices(size, 1)
    return rows, columns
