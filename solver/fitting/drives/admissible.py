"""Activations that a living muscle can make, and the barrier of that set.

With the stretches lambda_k of S(a_j) and the mean T_j of d d^T along its fibres d, muscle j has

    T_j : S(a_j) < fibre,    shortest < lambda_k < longest,    1/volume < det S(a_j) < volume,

a set that is convex but for the last bound: what lies between two such activations is one, too. Its
logarithmic barrier (Frisch 1955; Nocedal and Wright 2006, chapter 19), of all muscles,

    phi(A) = -log(fibre - T:A) - log det(A - shortest I) - log det(longest I - A)
             - log(log det A + log volume) - log(log volume - log det A),

is taken less its first-order part at rest, so that it pulls no muscle there.
:mod:`solver.fitting.interior_point` minimises with it.

The bounds hold exactly, which penalties do not, and the six numbers stay what they are for all that
plays, blends and draws them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.anatomy.physiology import SHORTEST, THICKEST
from solver.errors import Finding, InputError, make_warning
from solver.fitting.controls import Block
from solver.fitting.drives.muscle_bounds import COUNT, bring_inside, margins_of
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.stretches import (
    COLUMN,
    FROBENIUS,
    ROW,
    fibre_tensors,
    matrices,
    metric,
    with_stretches,
)
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class AdmissibleLimits:
    """Bounds of every muscle's activation S(a_j).

    A muscle pulls, so that its fibres hardly lengthen; it makes force down to half its best length
    (Zajac 1989), where a sheet that keeps its breadth is twice as thick, as it keeps its volume.
    The limits by which a certificate judges any fit are wider
    (:class:`~solver.rig.report.certificate.MuscleLimits`).
    """

    fibre: float = 1.02  # mean stretch along the fibres
    shortest: float = SHORTEST  # stretch in any direction
    longest: float = 0.95 * THICKEST
    volume: float = 1.1  # by that at rest, and its inverse

    def __post_init__(self) -> None:
        """Raise :class:`InputError` (``limits.rest``) where rest is not inside."""
        inside = self.shortest < 1.0 < min(self.longest, self.fibre, self.volume)
        if not (inside and self.shortest > 0.0):
            message = f"limits have to leave muscles at rest inside of every bound, not {self}"
            raise InputError("limits.rest", message)

    def loosen(self, part: float) -> AdmissibleLimits:
        """Return ``part`` of the way to :data:`FREE`; 0 is the same."""
        return replace(
            self,
            fibre=self.fibre + part * FREE.fibre,
            shortest=self.shortest * (1.0 - part),
            longest=self.longest + part * FREE.longest,
            volume=self.volume * FREE.volume**part,
        )


ADMISSIBLE = AdmissibleLimits()
# far beyond what free fits ask for
FREE = AdmissibleLimits(fibre=4.0, shortest=0.01, longest=4.5, volume=50.0)


@dataclass(frozen=True)
class PlausibilityOptions:
    """Loosening of limits, as a part of the way to :data:`FREE`.

    Half of what loose bounds gain comes in the first eighth of the way; the power spreads that over
    the scale, so that the skin comes nearer evenly.
    """

    loosest: float = 0.5  # part at plausibility 0: muscles reach it in hardly any fit
    power: float = 3.0  # of what plausibility lacks to 1


def limits_by_plausibility(
    plausibility: float, options: PlausibilityOptions = PlausibilityOptions()
) -> AdmissibleLimits:
    """Return limits for a plausibility from 0, nearly free, to 1, the limits as they are."""
    part = options.loosest * (1.0 - plausibility) ** options.power
    return AdmissibleLimits().loosen(part)


@dataclass(frozen=True)
class ProjectionOptions:
    """Effort to bring activations into the set."""

    rounds: int = 20  # of projections onto one bound after the other
    further: float = 1.01  # than asked for: the last steps of many would go on for ever
    shrink: float = 0.9  # of the distance to rest, where those do not end
    shrinks: int = 200


@dataclass(frozen=True)
class AdmissibleSet:
    """The admissible activations of m muscles; ``tensors`` (m, 3, 3) are T, NaN without fibres."""

    limits: AdmissibleLimits
    tensors: Floats
    options: ProjectionOptions = ProjectionOptions()

    def margins(self, a: Floats) -> Floats:
        """Return how far activations (m, 6) are inside every bound, (m, 9): above 0 if they are."""
        out = np.empty((len(a), COUNT))
        margins_of(a, self._along, self._limits, out, np.empty((0, COUNT, 6)))
        return out

    def contains(self, a: Floats) -> bool:
        """Tell whether activations (m, 6) are in the set, all of them."""
        return bool((self.margins(a) > 0.0).all())

    @cached_property
    def _limits(self) -> Floats:
        limits = self.limits
        volume = np.log(limits.volume)
        return np.array([limits.fibre, limits.shortest, limits.longest, volume])

    @cached_property
    def at_rest(self) -> Floats:
        """The margins (m, 9) of muscles at rest."""
        return self.margins(np.tile(IDENTITY, (len(self.tensors), 1)))

    def linearise(self, a: Floats) -> tuple[Floats, Floats]:
        """Return the margins (m, 9) and their derivatives (m, 9, 6).

        Where two stretches are the same their derivatives are those along any two axes of theirs.
        """
        margins = np.empty((len(a), COUNT))
        slopes = np.empty((len(a), COUNT, 6))
        margins_of(a, self._along, self._limits, margins, slopes)
        return margins, slopes

    def _fibres(self, a: Floats) -> Floats:
        """Return T_j : S(a_j), (m,); 1 without fibres."""
        return np.where(self._has_fibres, (self._along * a).sum(axis=1), 1.0)

    @cached_property
    def _has_fibres(self) -> Floats:
        return np.isfinite(self.tensors[:, 0, 0])

    @cached_property
    def _along(self) -> Floats:
        """The derivative (m, 6) of T_j : S(a_j)."""
        return np.asarray(FROBENIUS * np.nan_to_num(self.tensors)[:, ROW, COLUMN])

    def nearest(self, a: Floats, kept: float) -> Floats:
        """Return activations (m, 6) in the set and near ``a``, ``a`` itself where it is.

        ``kept`` is the least distance to every bound, by that at rest.
        """
        options = self.options
        found = np.array(a)
        least = kept * self.at_rest
        effort = options.further, options.rounds, options.shrink, options.shrinks
        bring_inside(found, self._along, self._limits, least, *effort)
        return found

    def value(self, a: Floats) -> float:
        """Return the barrier of activations (m, 6), infinite on a bound and beyond."""
        margins = self.margins(a)
        if not (margins > 0.0).all():
            return np.inf
        by_fibre, by_stretch = self._slopes_at_rest
        at_rest = by_fibre * (self._fibres(a) - 1.0) + by_stretch * (a @ IDENTITY - 3.0)
        return float(-np.log(margins).sum() - at_rest.sum())

    @property
    def _slopes_at_rest(self) -> tuple[float, float]:
        """The logarithms' derivatives at rest by the fibres' stretch and by any other one."""
        limits = self.limits
        by_stretch = 1.0 / (limits.longest - 1.0) - 1.0 / (1.0 - limits.shortest)
        return 1.0 / (limits.fibre - 1.0), by_stretch

    def gradient(self, a: Floats) -> Floats:
        """Return the barrier's derivative (m, 6)."""
        limits = self.limits
        values, axes = np.linalg.eigh(matrices(a))
        margins = self.margins(a)
        by_fibre, by_stretch = self._slopes_at_rest
        pull = 1.0 / margins[:, 0] - by_fibre
        by_size = 1.0 / margins[:, 8] - 1.0 / margins[:, 7]
        slopes = 1.0 / (limits.longest - values) - 1.0 / (values - limits.shortest) - by_stretch
        slopes += by_size[:, None] / values
        return np.asarray(FROBENIUS * with_stretches(slopes, axes) + pull[:, None] * self._along)

    def hessian(self, a: Floats) -> Floats:
        """Return the barrier's second derivative (m, 6, 6), its indefinite part left out."""
        values, axes = np.linalg.eigh(matrices(a))
        margins = self.margins(a)
        limits = self.limits
        by_size = FROBENIUS * with_stretches(1.0 / values, axes)
        bound = (margins[:, 7] ** -2 + margins[:, 8] ** -2)[:, None, None]
        # log det is concave: it stiffens its lower bound and softens the upper one
        convex = np.maximum(1.0 / margins[:, 7] - 1.0 / margins[:, 8], 0.0)[:, None, None]
        out = metric(a - limits.shortest * IDENTITY) + metric(limits.longest * IDENTITY - a)
        out += convex * metric(a) + bound * _outer(by_size)
        return np.asarray(out + _outer(self._along / margins[:, :1]))


def _outer(vectors: Floats) -> Floats:
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])


@dataclass(frozen=True)
class Admissible(SixNumbers):
    """Six numbers a muscle within ``limits``, along the fibres that the face's S gives it.

    In models without fibres nothing keeps muscles from pushing.
    """

    limits: AdmissibleLimits = ADMISSIBLE

    @override
    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        free = super().block(model, flesh, S)
        return replace(free, feasible=self.feasible(model, flesh.volumes, S))

    @override
    def feasible(self, model: SubjectModel, volumes: Floats, S: sp.csr_array) -> AdmissibleSet:
        return AdmissibleSet(self.limits, fibre_tensors(model, volumes, S))

    @override
    def loosen(self, part: float) -> Admissible:
        return Admissible(self.limits.loosen(part))

    @override
    def lacks(self, model: SubjectModel) -> list[Finding]:
        if model.fibres is not None:
            return []
        message = "the model has no fibres, so that muscles may push: build it again"
        return [make_warning("model.no_fibres", message)]
