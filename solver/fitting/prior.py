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

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from solver.fitting.controls import Layout
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose
from solver.fitting.information import inverse_of_positive
from solver.fitting.objective import Prior
from solver.surface import Floats


@dataclass(frozen=True)
class PriorOptions:
    """Strength of expressions, and the spread of what none of them does."""

    strength: float = 0.5  # standard deviation of an expression's amount
    own_strength: float = 0.0  # of a muscle's amount by itself
    known: Literal["template", "scans", "nothing"] = "template"  # which of a block's spreads holds


# Of a person's few scans. Without muscles that act by themselves no floor does as well: by the
# flesh's linear response 79 markers left 0.88 mm (0.3) and 1.03 mm (0.6), these leave 0.83 mm.
OF_SCANS = PriorOptions(own_strength=0.5, known="scans")
LOOSE = PriorOptions(known="nothing")


@dataclass(frozen=True)
class GaussianPrior(Prior):
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

    @override
    def value(self, pose: Pose) -> float:
        away = pose.vector() - self.mean
        return float(0.5 * away @ self.precision @ away)

    @override
    def gradient(self, pose: Pose) -> Floats:
        return np.asarray(self.precision @ (pose.vector() - self.mean))

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        out += self.precision

    def about(self, mean: Floats) -> GaussianPrior:
        """Return the same distribution about another mean (k,)."""
        found = replace(self, mean=mean)
        vars(found)["precision"] = self.precision  # is not inverted again
        return found

    def after(self, mean: Floats, covariance: Floats, seconds: float, time: float) -> GaussianPrior:
        """Return the prior so long after a frame whose posterior was N(mean, covariance)."""
        kept = kept_part(seconds, time)
        spread = kept**2 * covariance + (1.0 - kept**2) * self.covariance
        return GaussianPrior(self.fade(mean, kept), spread)

    def fade(self, mean: Floats, kept: float) -> Floats:
        """Return a mean (k,) of which a part is ``kept`` on its way back to rest."""
        return np.asarray(self.mean + kept * (mean - self.mean))


def kept_part(seconds: float, time: float) -> float:
    """Return the part of a control that is left so long after a frame, as it fades to rest."""
    return float(np.exp(-seconds / time))


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


def from_basis(
    face: Face, basis: ExpressionBasis, options: PriorOptions = PriorOptions()
) -> GaussianPrior:
    """Return the prior of a template's expressions, by the changes of the controls that make them.

    The linear response at rest errs where flesh moves far: with it 79 markers left 1.12 mm on wide
    open mouths, with large shapes fitted 0.96 mm.
    """
    known = from_changes(face.layout, np.vstack(basis.changes), options)
    return replace(known, shapes=basis.shapes)
