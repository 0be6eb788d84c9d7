"""Drive a reduced skin of expressions by markers as they come, at capture rate.

The markers' places follow from the slider values c (k,) alone, so a frame is a few Gauss-Newton
steps in k numbers, with the head eliminated by the same term as in fits of takes
(:mod:`solver.fitting.markers.term`) and wrong points judged in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.fitting.information import inverse_of_positive
from solver.fitting.markers.robust import Judge, RobustOptions
from solver.fitting.markers.term import HeadOptions, HeadPrior, MarkerPlaces, MarkerTerm
from solver.fitting.prior import GaussianPrior
from solver.model import SubjectModel
from solver.rig.frames.skin_basis import ReducedSkin
from solver.rig.preview.sliders import Sliders
from solver.scans.markers.places.marker_set import Marker, MarkerSet
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
        self._rest = super().corners(model.rest).reshape(-1, 3)
        self._on_jaw = np.repeat([marker.part == "lower_teeth" for marker in markers], 3)
        layout = sliders.rest.layout
        self._jaw_rates = sliders.directions[layout.joint_places]

    def corners(self, x: Floats) -> Floats:
        """Return the corners (k, 3, 3) of the markers' triangles for slider values x (s,)."""
        points = self._rest + (self._skin.amounts(x) @ self._basis).reshape(-1, 3)
        if self._on_jaw.any():
            b = self._sliders.pose(x).b
            points[self._on_jaw] = self._sliders.jaw.move(self._rest[self._on_jaw], b)
        return np.asarray(points.reshape(-1, 3, 3))

    def jacobian(self, x: Floats) -> Floats:
        """Return the derivative of the places by slider values, (3 k, s)."""
        by_corner = (self._basis.T @ self._skin.amount_rates(x)).reshape(-1, 3, len(x))
        if self._on_jaw.any():
            b = self._sliders.pose(x).b
            direct = self._sliders.jaw.jacobian(self._rest[self._on_jaw], b)
            by_corner[self._on_jaw] = direct @ self._jaw_rates
        return self.motion(x, by_corner.reshape(len(self), 9, -1))


@dataclass(frozen=True)
class LiveOptions:
    """Numbers of a live frame; lengths in mm."""

    steps: int = 2  # Gauss-Newton steps of a frame
    spread: float = 0.4  # standard deviation of a slider
    lower: float = -0.2
    upper: float = 1.2
    forgetting: float = 1.0  # s in which a slider that nothing tells of fades to 1/e
    noise_mm: float = 0.5  # of a point, with the preview's own error
    robust: RobustOptions = field(default_factory=RobustOptions)
    head: HeadOptions = field(default_factory=lambda: HeadOptions(steps=8))


@dataclass(frozen=True)
class LiveFrame:
    """Controls of one frame, and what became of its points."""

    controls: Floats  # (s,) slider values
    head: Similarity  # motion into the take, in the model's axes
    residuals: Floats  # (k,) mm, NaN where nothing was seen
    states: NDArray[np.str_]  # (k,) seen, missing, outlier, swapped or relabelled


@dataclass(frozen=True)
class LiveState:
    """State from frame to frame: slider values (s,), their covariance, and the head."""

    values: Floats
    covariance: Floats  # (s, s)
    head: HeadPrior | None = None  # None before the first frame


class LiveTracker:
    """Follows markers with the sliders of :func:`solver.rig.preview.make_live_preview`.

    Frames come ``seconds`` after each other; ``state`` is the last one's.

    ``error_mm`` is the preview's own mean distance from the simulation, which residuals include.
    """

    def __init__(
        self,
        model: SubjectModel,
        sliders: Sliders,
        skin: ReducedSkin,
        markers: MarkerSet,
        seconds: float,
        error_mm: float = 0.0,
        options: LiveOptions = LiveOptions(),
    ) -> None:
        used = [marker for marker in markers.markers if marker.part != "ignore"]
        self.labels = tuple(marker.label for marker in used)
        self.places = ReducedPlaces(model, sliders, skin, used)
        self.error_mm = error_mm
        self._session = markers.session
        self._seconds = seconds
        self._options = options
        self._judge = Judge(self.places, options.robust, options.head)
        variance = np.array([each.sigma_mm for each in used]) ** 2 + options.noise_mm**2
        self._precision = np.tile((1.0 / variance)[:, None], (1, 3))
        self._prior = GaussianPrior(
            np.zeros(len(sliders)), options.spread**2 * np.eye(len(sliders))
        )
        self.begin()

    def begin(self, state: LiveState | None = None) -> None:
        """Go on from a frame, or begin at rest."""
        self.state = state or LiveState(self._prior.mean, self._prior.covariance)

    def step(self, points: Floats) -> LiveFrame:
        """Follow a frame: points (k, 3) in the take's axes, mm, in the order of ``labels``."""
        options = self._options
        before = self.state
        seen = self._session(points)
        seconds = self._seconds
        forgetting = options.forgetting
        prior = self._prior.after(before.values, before.covariance, seconds, forgetting)
        values = np.clip(prior.mean, options.lower, options.upper)
        jacobian = self.places.jacobian(values)
        places = self.places.at(values)
        spread = jacobian @ prior.covariance @ jacobian.T
        head = self._head_before(seen)
        judged, term = self._judge.term(head, places, spread, seen, self._precision)
        values, normal = self._fit(term, prior, values, jacobian)
        placed = term.place(self.places.at(values))
        head = HeadPrior(placed.head, placed.precision)
        self.state = LiveState(values, inverse_of_positive(normal), head)
        residuals = np.linalg.norm(placed.points - judged.points, axis=1)
        return LiveFrame(values, placed.head, residuals, judged.states)

    def _fit(
        self, term: MarkerTerm, prior: GaussianPrior, values: Floats, jacobian: Floats
    ) -> tuple[Floats, Floats]:
        """Return the values (s,) that a few steps lead to, and the last one's matrix (s, s).

        ``jacobian`` is the places' derivative (3 k, s) at the ``values`` they begin with.
        """
        options = self._options
        precision = prior.precision
        for number in range(options.steps):
            if number:
                jacobian = self.places.jacobian(values)
            placed = term.place(self.places.at(values))
            pull = (term.precision * placed.offsets) @ placed.head.rotation
            slope = jacobian.T @ pull.ravel() + precision @ (values - prior.mean)
            normal = term.normal(placed, jacobian) + precision
            change = scipy.linalg.solve(normal, slope, assume_a="pos")
            values = np.clip(values - change, options.lower, options.upper)
        return values, normal

    def _head_before(self, seen: Floats) -> HeadPrior:
        at = self.places.at(self.state.values)
        weights = self._precision.mean(axis=1)
        known = self.state.head
        options = self._options.head
        return HeadPrior.before_frame(known, self._seconds, at, seen, weights, options)
