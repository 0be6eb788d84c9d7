"""Fit a take frame by frame: activations, jaw and head from labelled points, wrong ones rejected.

A frame begins with what is probable after the one before it (:meth:`GaussianPrior.after`), which
predicts every marker's place with a spread. By that points are weighed and labels mended
(:mod:`.robust`), then the face is fitted (:class:`~solver.fitting.sequence.Tracker`). The posterior
that comes of it is the next frame's memory; of controls that nothing tells of any more it keeps
the last value, which fades to the rest with the prior's time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from solver.errors import SolveError
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.information import Posterior, inverse_of_positive
from solver.fitting.markers.robust import JudgedFrame, Prediction, RobustOptions, judge
from solver.fitting.markers.term import (
    HeadOptions,
    HeadPrior,
    MarkerPlaces,
    MarkerTerm,
    PlacedMarkers,
)
from solver.fitting.objective import Regulariser
from solver.fitting.prior import GaussianPrior, PriorSum
from solver.fitting.sensitivity import Jacobian
from solver.fitting.sequence import Tracker, TrackingOptions
from solver.similarity import Similarity, robust_motion
from solver.surface import Floats


@dataclass(frozen=True)
class MarkerOptions:
    """Numbers of tracking markers; lengths in mm."""

    forgetting: float = 1.0  # s in which a control that nothing tells of fades to 1/e
    hold_below: float = 0.2  # information of a muscle under which it is held
    noise_mm: float = 0.2  # standard deviation of a point, beside that of its marker's place
    w_v: float = 0.3  # of volume, beside half a squared Mahalanobis distance
    w_e: float = 3.0  # of least eigenvalues
    # spread that a head's motion gains in a second
    turn_rad: float = 0.3
    shift_mm: float = 60.0
    # spread of the first frame's head about where most markers say
    first_turn_rad: float = 0.3
    first_shift_mm: float = 30.0
    placed_within_mm: float = 8.0  # of where the resting face has it a marker tells of the head
    placings: int = 20  # rounds of that
    max_iterations: int = 15  # of a frame that is fitted as any expression is
    robust: RobustOptions = field(default_factory=RobustOptions)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)


@dataclass(frozen=True)
class MarkerMemory:
    """What a frame leaves to the next: the posterior of controls and head."""

    mean: Floats  # (k,)
    covariance: Floats  # (k, k)
    head: HeadPrior


@dataclass(frozen=True)
class MarkerFit:
    """One frame of a take, fitted; ``predicted`` where nothing was seen that counts."""

    state: PosedFace
    placed: PlacedMarkers
    judged: JudgedFrame
    sd: Floats  # (k,) of the controls
    information: Floats  # (k,) of this frame alone
    held: np.ndarray  # (m,) muscles
    predicted: bool
    steps: int

    @property
    def residual_mm(self) -> Floats:
        """Return how far each point is off the fitted face's marker, (k,), NaN without one."""
        off = np.linalg.norm(self.placed.points - self.judged.points, axis=1)
        return np.asarray(off)


class MarkerTracker:
    """Fits frames in their order, ``dt`` seconds apart.

    ``prior`` is that of any pose; ``sigma`` (k,) are standard deviations of the markers' places on
    the face, mm.
    """

    def __init__(
        self,
        face: Face,
        places: MarkerPlaces,
        sigma: Floats,
        prior: GaussianPrior,
        seconds: float,
        options: MarkerOptions = MarkerOptions(),
    ) -> None:
        self.face, self.places, self.prior = face, places, prior
        self._sigma, self.seconds, self.options = sigma, seconds, options
        self._penalties = Regulariser(
            w_a=0.0, w_v=options.w_v, w_b=0.0, prior=face.rest_pose(), w_e=options.w_e
        )
        self.begin(face.rest, None)

    def begin(self, state: PosedFace, memory: MarkerMemory | None) -> None:
        """Go on from a frame: its state and what it left, None before the first."""
        options = self.options
        self.memory = memory
        self._moved: tuple[PosedFace, Jacobian, Floats] | None = None
        self.tracker = Tracker(
            self.face,
            self._penalties,
            state,
            max_iterations=options.max_iterations,
            options=options.tracking,
        )
        unseen = np.zeros((len(self.places), 3))
        self.tracker.relinearise(MarkerTerm(self.places, unseen, unseen), unseen)

    def fit(
        self, seen: Floats, unlabelled: Floats | None = None, sigma: Floats | None = None
    ) -> MarkerFit:
        """Fit a frame: points ``seen`` (k, 3), NaN where missing, of the take's axes in mm.

        ``unlabelled`` (u, 3) are points that may be any marker's; ``sigma`` (k, 3) the system's own
        standard deviations. Raises :class:`SolveError` if the face cannot be brought there.
        """
        options = self.options
        noise = np.full((1, 3), options.noise_mm) if sigma is None else sigma
        precision = 1.0 / (self._sigma[:, None] ** 2 + noise**2)
        prior, head = self._before(seen)
        state = self.tracker.state
        prediction, _ = self._predict(prior, head, precision)
        free = np.zeros((0, 3)) if unlabelled is None else unlabelled
        judged = judge(prediction, seen, precision, free, options.robust)
        used = precision * judged.weights[:, None]
        term = MarkerTerm(self.places, np.where(used > 0.0, judged.points, np.nan), used, head)
        predicted = not used.any()
        steps = 0
        if predicted:
            with suppress(SolveError):  # out of reach: it stays where it is
                self.tracker.go_to(state.pose.add(prior.mean - state.pose.vector()))
        else:
            steps = self.tracker.fit_term(term, used, PriorSum((prior, self._penalties)))
        return self._leave(term, judged, prior, predicted, steps)

    def normal(self, pose: Pose, head: Similarity, weights: Floats, number: int) -> Floats:
        """Return what markers with ``weights`` (k,) tell of the controls of a pose, (q, q).

        The poses come in their order; sensitivities are made anew after as many as frames take.
        """
        with suppress(SolveError):  # out of reach: as the frame before
            self.tracker.go_to(pose)
        state = self.tracker.state
        places = self.places.at(state.x)
        noise = self._sigma**2 + self.options.noise_mm**2
        used = np.tile((weights / noise)[:, None], (1, 3))
        unknown = HeadPrior(head, HeadPrior.unknown().precision)
        term = MarkerTerm(self.places, head(places), used, unknown)
        if number % self.options.tracking.lagged_frames == 0:
            self.tracker.relinearise(term, used)
        by_controls = self._by_controls()
        return np.asarray(by_controls.T @ term.inner(term.place(places)) @ by_controls)

    def _before(self, seen: Floats) -> tuple[GaussianPrior, HeadPrior]:
        """Return what is probable of controls and head before a frame is looked at."""
        options, memory = self.options, self.memory
        if memory is None:
            return self.prior, self._first_head(seen)
        seconds = self.seconds
        prior = self.prior.after(memory.mean, memory.covariance, seconds, options.forgetting)
        gained = np.repeat([options.turn_rad**2, options.shift_mm**2], 3) * seconds
        spread = inverse_of_positive(memory.head.precision) + np.diag(gained)
        return prior, HeadPrior(memory.head.motion, inverse_of_positive(spread))

    def _first_head(self, seen: Floats) -> HeadPrior:
        """Return where most of a frame's markers say that the head is."""
        options, known = self.options, np.isfinite(seen).all(axis=1)
        sd = np.repeat([options.first_turn_rad, options.first_shift_mm], 3)
        if known.sum() < 3:
            return HeadPrior.unknown(HeadOptions())
        at = self.places.at(self.tracker.state.x)[known]
        weights, slack = 1.0 / self._sigma[known] ** 2, options.placed_within_mm
        motion = robust_motion(at, seen[known], weights, 1e6, 1)
        motion = robust_motion(at, seen[known], weights, slack, options.placings, motion)
        return HeadPrior(motion, np.diag(sd**-2))

    def _predict(
        self, prior: GaussianPrior, head: HeadPrior, precision: Floats
    ) -> tuple[Prediction, Floats]:
        """Return the markers' places in the take, and their derivative (3 k, q) by the controls."""
        state, motion = self.tracker.state, head.motion
        by_controls = self._by_controls()
        change = prior.mean - state.pose.vector()
        places = self.places.at(state.x) + (by_controls @ change).reshape(-1, 3)
        term = MarkerTerm(self.places, motion(places), precision, head)
        placed = term.place(places)
        turned = np.einsum("ij,kjq->kiq", motion.rotation, by_controls.reshape(-1, 3, len(change)))
        turned = turned.reshape(by_controls.shape)
        by_head = placed.by_head
        spread = turned @ prior.covariance @ turned.T
        spread += by_head @ np.linalg.solve(head.precision, by_head.T)
        return Prediction(motion(places), spread), by_controls

    def _by_controls(self) -> Floats:
        """Return the derivative (3 k, q) of the markers' places in the head's frame."""
        jacobian, state = self.tracker.jacobian, self.tracker.state
        assert jacobian is not None, "made when tracking began"
        # a frame ends with what the next begins with
        if self._moved is None or self._moved[0] is not state or self._moved[1] is not jacobian:
            found = jacobian.motion(self.places.jacobian(state.x))
            self._moved = state, jacobian, found
        return self._moved[2]

    def _leave(
        self,
        term: MarkerTerm,
        judged: JudgedFrame,
        prior: GaussianPrior,
        predicted: bool,
        steps: int,
    ) -> MarkerFit:
        """Return the frame and remember its posterior."""
        state = self.tracker.state
        placed = term.place(self.places.at(state.x))
        by_controls = self._by_controls()
        normal = by_controls.T @ term.inner(placed) @ by_controls
        posterior = Posterior(inverse_of_positive(prior.precision + normal), prior.variance)
        spread = inverse_of_positive(self.prior.precision + normal)
        alone = Posterior(spread, self.prior.variance)
        head = HeadPrior(placed.head, placed.precision)
        self.memory = MarkerMemory(state.pose.vector(), posterior.covariance, head)
        layout = state.pose.layout
        muscles = layout.places("activations").reshape(self.face.model.muscle_count, -1)
        held = alone.information_of(muscles) < self.options.hold_below
        return MarkerFit(
            state, placed, judged, posterior.sd, alone.information, held, predicted, steps
        )
