"""Follow places on a face with the sliders of a reduced skin, at capture rate.

Places follow from the slider values c (s,) alone, so a frame is a few Gauss-Newton steps in s
numbers, with the head eliminated by the same term as in fits of takes
(:mod:`solver.fitting.markers.term`) and wrong points judged in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from solver.fitting.information import inverse_of_positive, solve_positive
from solver.fitting.markers.prediction import RatedPlaces
from solver.fitting.markers.robust import Judge, JudgedFrame, RobustOptions
from solver.fitting.markers.term import HeadOptions, HeadPrior, MarkerPlaces, MarkerTerm
from solver.fitting.prior import GaussianPrior
from solver.live.source import FollowedFace, LiveSource
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import Marker, places_over
from solver.similarity import Similarity
from solver.surface import Floats


class ReducedPlaces(MarkerPlaces):
    """Places of k markers in the head's frame, by slider values c (s,)."""

    def __init__(
        self, model: SubjectModel, sliders: Sliders, skin: ReducedSkin, markers: Sequence[Marker]
    ) -> None:
        super().__init__(model, markers)
        self._sliders = sliders
        self._skin = skin
        ids = np.array([marker.vertices for marker in markers], np.int64).ravel()
        on_bone = np.repeat([marker.place_mm is not None for marker in markers], 3)
        basis = np.where(on_bone[:, None], 0.0, skin.basis[:, ids].astype(np.float64))
        self._basis = basis.reshape(len(basis), -1)
        # (k, 9, r) of each triangle's corners by the amounts
        by_amounts = basis.reshape(len(basis), len(markers), 9).transpose(1, 2, 0)
        self._by_amounts = np.ascontiguousarray(by_amounts)
        self._rest = super().corners(model.rest).reshape(-1, 3)
        on_jaw = np.array([marker.part == "lower_teeth" for marker in markers], bool)
        self._on_jaw = np.flatnonzero(on_jaw)
        self._jaw_corners = np.flatnonzero(np.repeat(on_jaw, 3))
        layout = sliders.rest.layout
        self._jaw_rates = sliders.directions[layout.joint_places]
        self._last: _Placed | None = None

    @override
    def at(self, x: Floats) -> Floats:
        return self._placed(x).places

    @override
    def corners(self, x: Floats) -> Floats:
        """Return the corners (k, 3, 3) of the markers' triangles for slider values x (s,)."""
        return self._placed(x).corners

    def _placed(self, x: Floats) -> _Placed:
        # a frame asks several times, and the next begins where it ended
        if self._last is None or not np.array_equal(self._last.values, x):
            amounts, rates = self._skin.amounts_and_rates(x)
            points = self._rest + (amounts @ self._basis).reshape(-1, 3)
            if len(self._on_jaw):
                still = self._rest[self._jaw_corners]
                points[self._jaw_corners] = self._sliders.jaw.move(
                    still, self._sliders.jaw_numbers(x)
                )
            corners = points.reshape(-1, 3, 3)
            places = places_over(corners, self.weights, self.heights)
            self._last = _Placed(x.copy(), rates, corners, places)
        return self._last

    def jacobian(self, x: Floats) -> Floats:
        """Return the derivative of the places by slider values, (3 k, s)."""
        by_corners = self.by_corners(x)
        rates = self._placed(x).amount_rates
        by_amounts = (by_corners @ self._by_amounts).reshape(-1, len(rates))
        found = (by_amounts @ rates).reshape(len(self), 3, -1)
        if len(self._on_jaw):
            still = self._rest[self._jaw_corners]
            direct = self._sliders.jaw.jacobian(still, self._sliders.jaw_numbers(x))
            direct = (direct @ self._jaw_rates).reshape(-1, 9, len(x))
            found[self._on_jaw] = by_corners[self._on_jaw] @ direct
        return np.asarray(found.reshape(3 * len(self), -1))


class _Placed(NamedTuple):
    """Places (k, 3) by slider values (s,), with the corners, and the amounts' rates (r, s)."""

    values: Floats
    amount_rates: Floats
    corners: Floats  # (k, 3, 3)
    places: Floats


@dataclass(frozen=True)
class FollowOptions:
    """Numbers of a followed frame; lengths in mm."""

    steps: int = 2  # Gauss-Newton steps of a frame
    spread: float = 0.4  # standard deviation of a slider
    lower: float = -0.2
    upper: float = 1.2
    forgetting: float = 1.0  # s in which a slider that nothing tells of fades to 1/e
    noise_mm: float = 0.5  # of a point, with the reduced skin's own error
    robust: RobustOptions = field(default_factory=RobustOptions)
    head: HeadOptions = field(default_factory=lambda: HeadOptions(steps=8))


FOLLOW = FollowOptions()


@dataclass(frozen=True)
class FollowedPoints:
    """Slider values of one frame, and what became of its points."""

    values: Floats  # (s,)
    head: Similarity  # motion into the take, in the model's axes
    # (k, 3) mm from the reduced skin to what was seen, in the head's axes, NaN where nothing was
    residuals: Floats
    states: NDArray[np.str_]  # (k,) seen, missing, outlier, swapped or relabelled


@dataclass(frozen=True)
class Memory:
    """What a frame leaves to the next: slider values (s,), their covariance, and the head."""

    values: Floats
    covariance: Floats  # (s, s)
    head: HeadPrior | None = None  # None before the first frame


@dataclass(frozen=True)
class ExpectedFrame:
    """Where points are expected before a frame is looked at."""

    head: HeadPrior
    at: Floats  # (k, 3) in the head's frame
    jacobian: Floats  # (3 k, s) their derivative by the values
    precision: Floats  # (s, s) of these


class PointJudge(Protocol):
    """Says which points of a frame count."""

    def term(
        self, expected: ExpectedFrame, seen: Floats, precision: Floats
    ) -> tuple[JudgedFrame, MarkerTerm]:
        """Return a frame judged, and its term; ``seen`` and ``precision`` are (k, 3)."""


class LabelJudge(PointJudge):
    """Judges points as in takes, where labels may be wrong."""

    def __init__(self, places: MarkerPlaces, options: FollowOptions) -> None:
        self._places = places
        self._judge = Judge(places, options.robust, options.head)

    @override
    def term(
        self, expected: ExpectedFrame, seen: Floats, precision: Floats
    ) -> tuple[JudgedFrame, MarkerTerm]:
        known = (expected.at, expected.jacobian, expected.precision)
        prediction = RatedPlaces.of(expected.head, self._places.centre, *known)
        return self._judge.term(expected.head, prediction, seen, precision)


class PlaceFollower:
    """Follows points at ``places`` by values of ``count`` sliders; the ``judge`` says which count.

    The points' own standard deviations are ``sigma`` (k, 3) in mm.
    """

    def __init__(
        self,
        places: ReducedPlaces,
        sigma: Floats,
        count: int,
        judge: PointJudge,
        options: FollowOptions = FOLLOW,
    ) -> None:
        self.places = places
        self.options = options
        self._judge = judge
        self._precision = 1.0 / (sigma**2 + options.noise_mm**2)
        self._prior = GaussianPrior(np.zeros(count), options.spread**2 * np.eye(count))
        self.begin()
        # compiles what frames call, so that the first of a session does not wait for it
        self.step(places.at(np.zeros(count)), 1.0)
        self.begin()

    def begin(self, memory: Memory | None = None) -> None:
        """Go on from a frame, or begin at rest."""
        self.memory = memory or Memory(self._prior.mean, self._prior.covariance)

    def resume(self, values: Floats, head: Similarity) -> None:
        """Go on from slider values (s,) and a head of which no more is known."""
        options = self.options.head
        sd = np.repeat([options.first_turn_rad, options.first_shift_mm], 3)
        self.begin(Memory(values, self._prior.covariance, HeadPrior(head, np.diag(sd**-2))))

    def step(self, seen: Floats, seconds: float) -> FollowedPoints:
        """Follow a frame ``seconds`` after the last: points ``seen`` (k, 3) in mm, NaN for none."""
        options = self.options
        before = self.memory
        head = self._head_before(seen, seconds)
        prior = self._prior.after(before.values, before.covariance, seconds, options.forgetting)
        values = np.clip(prior.mean, options.lower, options.upper)
        jacobian = self.places.jacobian(values)
        expected = ExpectedFrame(head, self.places.at(values), jacobian, prior.precision)
        judged, term = self._judge.term(expected, seen, self._precision)
        values, normal = self._fit(term, prior, values, jacobian)
        placed = term.place(self.places.at(values))
        head = HeadPrior(placed.head, placed.precision)
        self.memory = Memory(values, inverse_of_positive(normal), head)
        residuals = placed.head.inverse().turn(judged.points - placed.points)
        return FollowedPoints(values, placed.head, residuals, judged.states)

    def _fit(
        self, term: MarkerTerm, prior: GaussianPrior, values: Floats, jacobian: Floats
    ) -> tuple[Floats, Floats]:
        """Return the values (s,) that a few steps lead to, and the last one's matrix (s, s).

        ``jacobian`` is the places' derivative (3 k, s) at the ``values`` they begin with.
        """
        options = self.options
        precision = prior.precision
        for number in range(options.steps):
            if number:
                jacobian = self.places.jacobian(values)
            placed = term.place(self.places.at(values))
            pull = (term.precision * placed.offsets) @ placed.head.rotation
            slope = jacobian.T @ pull.ravel() + precision @ (values - prior.mean)
            normal = term.normal(placed, jacobian) + precision
            values = np.clip(values - solve_positive(normal, slope), options.lower, options.upper)
        return values, normal

    def _head_before(self, seen: Floats, seconds: float) -> HeadPrior:
        at = self.places.at(self.memory.values)
        weights = self._precision.mean(axis=1)
        known = self.memory.head
        return HeadPrior.before_frame(known, seconds, at, seen, weights, self.options.head)


class PlaceSource(LiveSource):
    """Base of sources whose frames are places (rows, 3): what was before is their follower's."""

    width = 3
    labels: tuple[str, ...] = ()
    _follower: PlaceFollower

    @override
    def begin(self) -> None:
        self._follower.begin()

    @override
    def resume(self, values: Floats, head: Similarity) -> None:
        self._follower.resume(values, head)


def as_live(found: FollowedPoints) -> FollowedFace:
    """Return followed points as a session has them."""
    counts = np.isin(found.states, ("missing", "outlier"), invert=True)
    left = np.where(counts[:, None], np.nan_to_num(found.residuals), 0.0)
    return FollowedFace(found.values, found.head, left.ravel(), not counts.any())
