"""Regress head and jaw from markers by a template's expressions, which move skin and teeth alike.

    y(w) = y(0) + B w,    t(w) = t(0) + T w,    w ~ N(0, s^2 I)

with B and T the motions of the markers and of the lower teeth by expressions. One Gauss-Newton step
of w and the head (:class:`.term.MarkerTerm`), from the expressions of the frame before, gives both
and the covariance C of t. The jaw is the b that carries the teeth there, with the precision
J^T (C + r^2 I)^-1 J for J = dt/db.

Flesh errs alike in all markers of a chin: it is followed about as well by a jaw that opens an
eighth less, and by a head that nods a little. A regression from the skin knows better where
they belong (jaws from skin: Zoss et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.fitting.expression_basis import follows_teeth, jaw_of_teeth
from solver.fitting.face import Face, PosedFace
from solver.fitting.information import inverse_of_positive
from solver.fitting.markers.term import HeadPrior, MarkerPlaces, MarkerTerm, PlacedMarkers
from solver.fitting.objective import PartPrior
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class RegressionOptions:
    """Spreads, and how much a regressed jaw counts; lengths in mm."""

    strength: float = 0.5  # standard deviation of an expression's amount
    skin_mm: float = 0.3  # of a marker off what expressions make of it
    # of the foremost lower tooth and the last on both sides: shapes move them along chords, which
    # no jaw follows with all three
    teeth_mm: tuple[float, float, float] = (0.3, 1.0, 1.0)
    # of the head and of the jaw, which markers on flesh outvote by their number
    head_weight: float = 3.0
    jaw_weight: float = 10.0


@dataclass(frozen=True)
class RegressedFrame:
    """The head as a frame's markers tell it, and the jaw, None where they are not asked for it."""

    head: HeadPrior
    jaw: PartPrior | None


class ShapeRegression:
    """Regresses frames; ``shapes`` (e, v, 3) are motions of the whole skin, mm.

    A free jaw is left to the skin, which it was fitted to, and one with markers of its own to them.
    """

    def __init__(
        self,
        face: Face,
        places: MarkerPlaces,
        shapes: NDArray[np.floating],
        options: RegressionOptions = RegressionOptions(),
    ) -> None:
        self._face = face
        self._places = places
        self._options = options
        self._at = places.at(face.model.rest)
        self._by_shapes = places.motion_by_skin(face.model.rest, shapes)
        self._known = options.strength**-2 * np.eye(len(shapes))
        # amounts by places, as far as expressions make them
        weighted = self._by_shapes.T / options.skin_mm**2
        self._amounts = np.linalg.solve(weighted @ self._by_shapes + self._known, weighted)
        self._teeth: Ints | None = None
        if follows_teeth(face) and not places.on_mandible.any():
            self._teeth = outermost_teeth(face)
            moved = np.asarray(shapes[:, self._teeth], np.float64)
            self._teeth_by_shapes = moved.reshape(len(shapes), -1).T

    def regress(self, term: MarkerTerm, near: PosedFace) -> RegressedFrame:
        """Return what the points of ``term`` tell of a face that is ``near`` another."""
        count = len(self._known)
        away = self._places.at(near.x) - self._at
        start = self._amounts @ away.ravel()
        amounts, placed, covariance = self._fit(self._loosen(term), start)
        known = term.head.precision
        gained = inverse_of_positive(covariance[count:, count:]) - known
        head = HeadPrior(placed.head, known + self._options.head_weight * gained)
        if self._teeth is None:
            return RegressedFrame(head, None)
        teeth = self._face.model.skin.vertices[self._teeth]
        goal = teeth + (self._teeth_by_shapes @ amounts).reshape(-1, 3)
        spread = self._teeth_by_shapes @ covariance[:count, :count] @ self._teeth_by_shapes.T
        return RegressedFrame(head, self._jaw(teeth, goal, spread, near.pose.b))

    def _loosen(self, term: MarkerTerm) -> MarkerTerm:
        """Return the term with less precision: skin strays from what expressions predict."""
        skin = np.where(self._places.on_skin, self._options.skin_mm**2, 0.0)
        precision = term.precision / (1.0 + skin[:, None] * term.precision)
        # a mandible with markers of its own may move otherwise than in any expression
        precision[self._places.on_mandible] = 0.0
        return replace(term, precision=precision)

    def _fit(self, term: MarkerTerm, amounts: Floats) -> tuple[Floats, PlacedMarkers, Floats]:
        """Return the amounts w (e,), the markers with their head, and the covariance of both."""
        precision = term.precision
        placed = term.place(self._displacements(amounts))
        turned = placed.head.rotation @ self._by_shapes.reshape(len(precision), 3, -1)
        rows = np.hstack([turned.reshape(precision.size, -1), placed.by_head])
        weighted = rows.T * precision.ravel()
        normal = weighted @ rows
        known = scipy.linalg.block_diag(self._known, term.head.precision)
        # the head is at its minimum: there is no slope by it
        slope = np.zeros(len(normal))
        slope[: len(amounts)] = (weighted @ placed.offsets.ravel())[: len(amounts)]
        slope[: len(amounts)] += self._known @ amounts
        step = scipy.linalg.solve(normal + known, -slope, assume_a="pos")
        amounts = amounts + step[: len(amounts)]
        placed = term.place(self._displacements(amounts))
        # what expressions leave of the markers says how far they are to be trusted
        left = float(np.sum(precision * placed.offsets**2))
        trusted = min(1.0, np.count_nonzero(precision) / max(left, 1e-12))
        return amounts, placed, inverse_of_positive(trusted * normal + known)

    def _displacements(self, amounts: Floats) -> Floats:
        return np.asarray(self._at + (self._by_shapes @ amounts).reshape(-1, 3))

    def _jaw(self, teeth: Floats, goal: Floats, spread: Floats, b: Floats) -> PartPrior:
        """Return the jaw that carries ``teeth`` (3, 3) to a ``goal`` of covariance ``spread``."""
        face = self._face
        options = self._options
        inner = inverse_of_positive(spread + np.diag(np.repeat(options.teeth_mm, 3) ** 2))
        places, found = jaw_of_teeth(face, teeth, goal, b, inner)
        rates = face.jaw.jacobian(teeth, found).reshape(len(inner), -1)
        return PartPrior(
            face.layout.size, places, found, options.jaw_weight * rates.T @ inner @ rates
        )


def outermost_teeth(face: Face) -> Ints:
    """Return three vertices of the lower teeth: the foremost and the last on both sides."""
    ids = face.model.lower_teeth
    across, _, ahead = (face.model.skin.vertices[ids] @ face.model.jaw.axes.T).T
    return np.array([ids[ahead.argmax()], ids[across.argmin()], ids[across.argmax()]])
