"""Predict where markers are, and measure how far off they were seen: a term of fits.

    y_k(x) = sum_i w_ki c_ki(x) + h_k n_k(x),    f(x) = min over the head of
             1/2 sum_k (R y_k + t - o_k)^T Lambda_k (R y_k + t - o_k) + 1/2 xi^T Pi xi

Corners c of a marker's triangle move with flesh, mandible or skull; n is the triangle's normal. The
head (R, t) is the predicted one followed by a small motion xi = (omega, tau) about the markers'
middle at rest, with the precision Pi. It is eliminated: with xi at a minimum f's gradient needs no
derivative of it (envelope theorem), and the Gauss-Newton matrix is a Schur complement. f is half a
squared Mahalanobis distance, without unit; robust weights are within Lambda.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from typing_extensions import override

from solver.anatomy.embedding import rows_of
from solver.contact.mouth import Mandible
from solver.fitting.information import inverse_of_positive
from solver.fitting.markers.placing import PlacedHead, place_head, rates_over
from solver.fitting.objective import GramCurvature, Term
from solver.fitting.sensitivity import Jacobian
from solver.model import SubjectModel
from solver.scans.markers.places.marker_set import BONY, Marker, places_over
from solver.similarity import IDENTITY, Similarity, robust_motion, weighted_motion
from solver.surface import Floats, skew

# corners of a marker's triangle on a bone, mm from it
_TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class MarkerPlaces:
    """Places of k markers in the head's frame, by the flesh's vertices x (p, 3)."""

    def __init__(self, model: SubjectModel, markers: Sequence[Marker]) -> None:
        self.weights = np.array([marker.weights for marker in markers]).reshape(-1, 3)
        self.heights = np.array([marker.height_mm for marker in markers])
        self._vertices = np.array([marker.vertices for marker in markers], np.int64).reshape(-1, 3)
        self.on_skin = np.array([marker.part not in BONY for marker in markers], bool)
        self.on_mandible = np.array([marker.part == "lower_teeth" for marker in markers], bool)
        self._corners, self._fixed = _corner_rows(model, markers)
        self._rows = sp.csr_array(sp.kron(self._corners, sp.eye_array(3), format="csr"))
        at_rest = np.asarray(self._corners @ model.rest + self._fixed).reshape(-1, 3, 3)
        # what a head's motion is counted about: it must not change with what is seen
        self.centre = np.einsum("ki,kix->kx", self.weights, at_rest).mean(axis=0)

    def __len__(self) -> int:
        return len(self.heights)

    def at(self, x: Floats) -> Floats:
        """Return the markers' places (k, 3), mm."""
        return places_over(self.corners(x), self.weights, self.heights)

    def corners(self, x: Floats) -> Floats:
        """Return the corners of the markers' triangles (k, 3, 3)."""
        return np.asarray(self._corners @ x + self._fixed).reshape(-1, 3, 3)

    def jacobian(self, x: Floats) -> sp.csr_array:
        """Return the derivative of the places by x, (3 k, 3 p)."""
        local = self.by_corners(x)
        count = len(local)
        # a marker's block (3, 9) stands in the columns of its own three corners
        columns = np.repeat(9 * np.arange(count)[:, None] + np.arange(9), 3, axis=0)
        indptr = 9 * np.arange(3 * count + 1)
        blocks = sp.csr_array((local.ravel(), columns.ravel(), indptr), (3 * count, 9 * count))
        return sp.csr_array(blocks @ self._rows)

    def gradient(self, x: Floats, pull: Floats) -> Floats:
        """Return the derivative by x, (p, 3), of what is ``pull`` (k, 3) by the places."""
        at_corners = np.einsum("kic,ki->kc", self.by_corners(x), pull)
        return np.asarray(self._rows.T @ at_corners.ravel()).reshape(x.shape)

    def corners_motion(self, jacobian: Jacobian) -> Floats:
        """Return the derivative of the corners by controls, (k, 9, q)."""
        return jacobian.motion(self._rows).reshape(len(self), 9, -1)

    def motion(self, x: Floats, corners: Floats) -> Floats:
        """Return the derivative (3 k, q) of the places; ``corners`` is :meth:`corners_motion`."""
        return np.asarray(self.by_corners(x) @ corners).reshape(-1, corners.shape[-1])

    def motion_by_skin(self, x: Floats, shapes: NDArray[np.floating]) -> Floats:
        """Return the derivative (3 k, e) of the places by amounts of motions (e, v, 3) of the skin.

        Markers on bones stay.
        """
        corners = np.asarray(shapes[:, self._vertices], np.float64) * self.on_skin[:, None, None]
        moved = corners.reshape(len(shapes), len(self), 9)
        found = np.einsum("kij,ekj->kie", self.by_corners(x), moved)
        return np.asarray(found.reshape(-1, len(shapes)))

    def by_corners(self, x: Floats) -> Floats:
        """Return each place's derivative (k, 3, 9) by its triangle's corners, one after another."""
        return np.asarray(rates_over(self.corners(x), self.weights, self.heights))


def _corner_rows(model: SubjectModel, markers: Sequence[Marker]) -> tuple[sp.csr_array, Floats]:
    """Return rows (3 k, p) and offsets (3 k, 3) that give triangles' corners by x.

    A marker on a bone is the first corner of a triangle that rides on it.
    """
    ids = np.array([marker.vertices for marker in markers], np.int64).ravel()
    parts = np.repeat([marker.part for marker in markers], 3)
    on_bone = np.isin(parts, BONY)
    on_jaw = parts == "lower_teeth"
    fixed = model.skin.vertices[ids].copy()
    for number, marker in enumerate(markers):
        if marker.place_mm is not None:
            fixed[3 * number : 3 * number + 3] = np.array(marker.place_mm) + _TRIANGLE
    row = np.full(len(model.skin.vertices), -1)
    row[model.embedded] = np.arange(len(model.embedded))
    on_flesh = ~on_bone & (row[ids] >= 0)
    on_jaw |= ~on_bone & ~on_flesh & np.isin(ids, model.attached_mandible)
    rows = sp.lil_array((len(ids), len(model.rest)))
    rows[on_flesh] = model.embedding[row[ids[on_flesh]]]
    if on_jaw.any():
        mandible = Mandible.of(model)
        shares = mandible.shares(fixed[on_jaw])
        corners = np.tile(mandible.corners, (len(shares), 1))
        rows[on_jaw] = rows_of(corners, shares, len(model.rest))
    fixed[on_flesh] = model.offset[row[ids[on_flesh]]]
    fixed[on_jaw] = 0.0
    return sp.csr_array(rows), fixed


def head_rates(arms: Floats) -> Floats:
    """Return the derivative (3 k, 6) by a small motion about a point of what is ``arms`` off it."""
    shifts = np.broadcast_to(np.eye(3), (len(arms), 3, 3))
    return np.concatenate([-skew(arms), shifts], axis=2).reshape(-1, 6)


@dataclass(frozen=True)
class HeadOptions:
    """The head's elimination, and what is known of it before a frame; lengths in mm."""

    steps: int = 30  # of Newton's method, at most
    accuracy: float = 1e-6  # of a step, rad and mm, that is not taken any more
    unknown_rad: float = 3.0  # standard deviations of a head that nothing is known of
    unknown_mm: float = 1e3
    # spread that a head's motion gains in a second
    turn_rad: float = 0.3
    shift_mm: float = 60.0
    # spread about where most markers of a frame have it; one that is less sure is placed again
    first_turn_rad: float = 0.3
    first_shift_mm: float = 30.0
    placed_within_mm: float = 8.0  # of its place on the face, a marker counts for the head
    placings: int = 20  # rounds of that


@dataclass(frozen=True)
class HeadPrior:
    """The head's predicted motion into the take, and the precision of a small one after it."""

    motion: Similarity
    precision: Floats  # (6, 6) of a rotation vector, rad, and a shift, mm

    @classmethod
    def diffuse(
        cls, options: HeadOptions = HeadOptions(), motion: Similarity = IDENTITY
    ) -> HeadPrior:
        """Return the prior of a head that may be anywhere, about a motion."""
        sd = np.repeat([options.unknown_rad, options.unknown_mm], 3)
        return cls(motion, np.diag(sd**-2))

    @classmethod
    def before_frame(
        cls,
        known: HeadPrior | None,
        seconds: float,
        places: Floats,
        seen: Floats,
        weights: Floats,
        options: HeadOptions = HeadOptions(),
    ) -> HeadPrior:
        """Return what is known of the head before a frame is fitted.

        The frame before has left it, so long ago. Before the first frame, or where the head is
        lost, most of the markers agree on it: see :meth:`of_most`.
        """
        head = None if known is None else known.after(seconds, options)
        if head is None or (head.is_lost(options) and np.isfinite(seen).all(axis=1).sum() >= 3):
            return cls.of_most(places, seen, weights, options)
        return head

    @classmethod
    def of_most(
        cls, places: Floats, seen: Floats, weights: Floats, options: HeadOptions = HeadOptions()
    ) -> HeadPrior:
        """Return the head as most markers place it; anywhere by fewer than three.

        They are at ``places`` (k, 3) in its frame, ``seen`` (k, 3) in the take, NaN for missing.
        """
        known = np.isfinite(seen).all(axis=1)
        if known.sum() < 3:
            return cls.diffuse(options)
        sd = np.repeat([options.first_turn_rad, options.first_shift_mm], 3)
        at = places[known]
        there = seen[known]
        weights = weights[known]
        motion = robust_motion(at, there, weights, 1e6, 1)
        slack = options.placed_within_mm
        motion = robust_motion(at, there, weights, slack, options.placings, motion)
        return cls(motion, np.diag(sd**-2))

    def after(self, seconds: float, options: HeadOptions = HeadOptions()) -> HeadPrior:
        """Return what is known of the head so long after."""
        gained = np.repeat([options.turn_rad**2, options.shift_mm**2], 3) * seconds
        spread = inverse_of_positive(self.precision) + np.diag(gained)
        return HeadPrior(self.motion, inverse_of_positive(spread))

    def is_lost(self, options: HeadOptions = HeadOptions()) -> bool:
        """Return whether a frame's markers determine the head's rotation better than this."""
        spread = np.diag(inverse_of_positive(self.precision))
        return bool(spread[:3].max() > options.first_turn_rad**2)


@dataclass(frozen=True)
class PlacedMarkers:
    """Markers in the take, with the head that they determine."""

    head: Similarity
    points: Floats  # (k, 3) predicted, mm
    offsets: Floats  # (k, 3) off what was seen; 0 for what was not
    by_head: Floats  # (3 k, 6) derivative by a further small motion
    precision: Floats  # (6, 6) of the head, the face being known


@dataclass(frozen=True)
class MarkerTerm(Term):
    """f for what was seen in one frame: an :class:`~solver.fitting.objective.Term`.

    ``seen`` (k, 3) may hold NaN where ``precision`` (k, 3), the diagonals of Lambda in the take's
    axes, is 0.
    """

    places: MarkerPlaces
    seen: Floats
    precision: Floats
    head: HeadPrior = field(default_factory=HeadPrior.diffuse)
    options: HeadOptions = HeadOptions()
    # the last places with what they gave, xi and f: value, gradient and curvature ask for the same;
    # a copy with other data begins without
    _known: list[tuple[Floats, PlacedMarkers, Floats, float]] = field(
        default_factory=list, init=False, compare=False
    )

    @override
    def value(self, x: Floats) -> float:
        self.place(self.places.at(x))
        return self._known[-1][-1]

    @override
    def gradient(self, x: Floats) -> Floats:
        placed = self.place(self.places.at(x))
        pull = (self.precision * placed.offsets) @ placed.head.rotation
        return self.places.gradient(x, pull)

    @override
    def curvature(self, x: Floats) -> GramCurvature:
        placed = self.place(self.places.at(x))
        return GramCurvature(self.places.jacobian(x), self.inner(placed))

    def inner(self, placed: PlacedMarkers) -> Floats:
        """Return f's Gauss-Newton matrix by the places in the head's frame, (3 k, 3 k)."""
        count = len(self.places)
        turn = placed.head.rotation
        # a marker's three rows, turned from the take's axes into the head's
        pulled = self.precision[:, :, None] * placed.by_head.reshape(count, 3, 6)
        pulled = np.einsum("ji,kjm->kim", turn, pulled).reshape(-1, 6)
        own = np.einsum("ji,kj,jm->kim", turn, self.precision, turn)
        out = -pulled @ np.linalg.solve(placed.precision, pulled.T)
        each = np.arange(3 * count).reshape(count, 3)
        out[each[:, :, None], each[:, None, :]] += own
        return np.asarray(out)

    def normal(self, placed: PlacedMarkers, by_controls: Floats) -> Floats:
        """Return by_controls^T :meth:`inner` by_controls, (q, q), for a matrix (3 k, q)."""
        root = np.sqrt(self.precision)
        turned = placed.head.rotation @ by_controls.reshape(len(root), 3, -1)
        rows = (root[:, :, None] * turned).reshape(root.size, -1)
        coupling = rows.T @ (root.reshape(-1, 1) * placed.by_head)
        return np.asarray(rows.T @ rows - coupling @ np.linalg.solve(placed.precision, coupling.T))

    def place(self, places: Floats) -> PlacedMarkers:
        """Place markers that are at ``places`` (k, 3) in the head's frame by what was seen."""
        known = self._known
        if known and np.array_equal(known[-1][0], places):
            return known[-1][1]
        # places that were asked for before are near by
        xi = known[-1][2] if known else self._start(places)
        options = self.options
        arms = self.head.motion(places) - self._centre
        seen = self.seen - self._centre
        about = (arms, seen, self.precision, self.head.precision)
        now: PlacedHead = place_head(*about, xi, options.steps, options.accuracy)
        xi = now.xi
        # the small motion is one about the centre
        shift = xi[3:] + self._centre
        before = self.head.motion
        turned = now.rotation @ (before.shift - self._centre)
        head = Similarity(before.scale, now.rotation @ before.rotation, turned + shift)
        points = now.arms + shift
        placed = PlacedMarkers(head, points, now.offsets, head_rates(now.arms), now.normal)
        own = np.sum(self.precision * now.offsets**2)
        value = 0.5 * float(own + xi @ self.head.precision @ xi)
        known[:] = [(places, placed, xi, value)]
        return placed

    def _start(self, places: Floats) -> Floats:
        """Return xi (6,) to begin with: of a lost head by least squares, all axes being alike."""
        weights = self.precision.mean(axis=1)
        if np.count_nonzero(weights) < 3 or not self.head.is_lost(self.options):
            return np.zeros(6)
        predicted = self.head.motion(places) - self._centre
        seen = np.where(weights[:, None] > 0.0, self.seen, 0.0) - self._centre
        return weighted_motion(predicted, seen, weights).twist

    @cached_property
    def _centre(self) -> Floats:
        """The point (3,) that the head turns about, in the take."""
        return np.asarray(self.head.motion(self.places.centre[None])[0])
