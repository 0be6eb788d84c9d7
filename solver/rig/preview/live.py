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
from solver.fitting.markers.robust import Prediction, RobustOptions, judge
from solver.fitting.markers.term import HeadOptions, HeadPrior, MarkerPlaces, MarkerTerm
from solver.fitting.prior import GaussianPrior
from solver.mechanics.boundary import jaw_jacobian, move_jaw
from solver.model import SubjectModel
from solver.rig.preview.sliders import Sliders
from solver.rig.skin_basis import ReducedSkin
from solver.scans.markers.marker_set import Marker, MarkerSet
from solver.similarity import Similarity
from solver.surface import Floats


class ReducedPlaces(MarkerPlaces):
    """Places of k markers in the head's frame, by slider values c (s,)."""

    def __init__(
        self, model: SubjectModel, sliders: Sliders, skin: ReducedSkin, markers: Sequence[Marker]
    ) -> None:
        super().__init__(model, markers)
        self._sliders, self._skin, self._jaw = sliders, skin, model.jaw
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
            points[self._on_jaw] = move_jaw(self._jaw, self._rest[self._on_jaw], b)
        return np.asarray(points.reshape(-1, 3, 3))

    def jacobian(self, x: Floats) -> Floats:
        """Return the derivative of the places by slider values, (3 k, s)."""
        by_corner = (self._basis.T @ self._skin.amount_rates(x)).reshape(-1, 3, len(x))
        if self._on_jaw.any():
            b = self._sliders.pose(x).b
            direct = jaw_jacobian(self._jaw, self._rest[self._on_jaw], b)
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


class LiveTracker:
    """Follows markers with the sliders of :func:`solver.rig.preview.make_live_preview`.

    Frames come ``seconds`` after each other.

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
        self._session, self._seconds, self._options = markers.session, seconds, options
        variance = np.array([each.sigma_mm for each in used]) ** 2 + options.noise_mm**2
        self._precision = np.tile((1.0 / variance)[:, None], (1, 3))
        self._values = np.zeros(len(sliders))
        self._covariance = options.spread**2 * np.eye(len(sliders))
        self._prior = GaussianPrior(self._values, self._covariance)
        self._head: HeadPrior | None = None

    def step(self, points: Floats) -> LiveFrame:
        """Follow a frame: points (k, 3) in the take's axes, mm, in the order of ``labels``."""
        options = self._options
        seen = self._session(points)
        prior = self._prior.after(self._values, self._covariance, self._seconds, options.forgetting)
        mean, head = prior.mean, self._head_before(seen)
        values = np.clip(mean, options.lower, options.upper)
        jacobian, places = self.places.jacobian(values), self.places.at(values)
        spread = jacobian @ prior.covariance @ jacobian.T
        prediction = Prediction.of(head, self.places.centre, places, spread)
        judged = judge(prediction, seen, self._precision, np.zeros((0, 3)), options.robust)
        used = self._precision * judged.weights[:, None]
        target = np.where(used > 0.0, judged.points, np.nan)
        term = MarkerTerm(self.places, target, used, head, options.head)
        precision = prior.precision
        for number in range(options.steps):
            if number:
                jacobian, places = self.places.jacobian(values), self.places.at(values)
            placed = term.place(places)
            pull = (used * placed.offsets) @ placed.head.rotation
            slope = jacobian.T @ pull.ravel() + precision @ (values - mean)
            normal = term.normal(placed, jacobian) + precision
            change = scipy.linalg.solve(normal, slope, assume_a="pos")
            values = np.clip(values - change, options.lower, options.upper)
        placed = term.place(self.places.at(values))
        self._values, self._covariance = values, inverse_of_positive(normal)
        self._head = HeadPrior(placed.head, placed.precision)
        residuals = np.linalg.norm(placed.points - judged.points, axis=1)
        return LiveFrame(values, placed.head, residuals, judged.states)

    def _head_before(self, seen: Floats) -> HeadPrior:
        at, weights = self.places.at(self._values), self._precision.mean(axis=1)
        options = self._options.head
        return HeadPrior.before_frame(self._head, self._seconds, at, seen, weights, options)
