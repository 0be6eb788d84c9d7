"""Fit a take frame by frame: activations, jaw and head from labelled points, wrong ones rejected.

A frame begins with what is probable after the one before it (:meth:`GaussianPrior.after`), which
predicts every marker's place with a spread. By that points are weighed and labels mended
(:mod:`.robust`), then the face is fitted (:class:`~solver.fitting.sequence.Tracker`). The posterior
that comes of it is the next frame's memory; controls that no marker determines any more keep their
last value, which fades to the rest with the prior's time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from solver.contact.mouth import Mouth
from solver.errors import SolveError
from solver.fitting.contact import NearContact
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.information import Posterior
from solver.fitting.least_squares import StopOptions
from solver.fitting.markers.filter import ControlFilter, Evidence, FilterOptions, KnownControls
from solver.fitting.markers.robust import JudgedFrame, Prediction, RobustOptions, judge
from solver.fitting.markers.shape_regression import RegressionOptions, ShapeRegression
from solver.fitting.markers.term import (
    HeadOptions,
    HeadPrior,
    MarkerPlaces,
    MarkerTerm,
    PlacedMarkers,
)
from solver.fitting.objective import Prior, Regulariser
from solver.fitting.prior import GaussianPrior, PartPrior, PriorSum
from solver.fitting.sensitivity import Jacobian
from solver.fitting.sequence import Tracker, TrackingOptions
from solver.mechanics.equilibrium import CorrectorOptions
from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class MarkerOptions:
    """Numbers of tracking markers; lengths in mm."""

    hold_below: float = 0.2  # information of a muscle under which it is held ...
    hold_sd: float = 0.01  # ... so closely, in a control's units
    alike: float = 0.25  # relative change of a weight up to which evidence is used again
    noise_mm: float = 0.2  # standard deviation of a point, beside that of its marker's place
    w_v: float = 0.3  # of volume, beside half a squared Mahalanobis distance
    w_e: float = 3.0  # of least eigenvalues
    lips: float = 2.0  # weight of every third vertex of a lip in the other, per mm^2 ...
    lips_slack_mm: float = 0.2  # ... beyond this depth
    max_iterations: int = 15  # of a frame that is fitted as any expression is
    head: HeadOptions = field(default_factory=HeadOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    regression: RegressionOptions = field(default_factory=RegressionOptions)
    # a step that promises less of half a squared Mahalanobis distance is one of noise: so faces are
    # as near as with a tenth of it, in two thirds of the time. The one step left is long, and so
    # are its corrections; nor need they end as near as where several steps follow
    tracking: TrackingOptions = field(
        default_factory=lambda: TrackingOptions(
            stop=StopOptions(3, promised=6e-2),
            corrector=CorrectorOptions(long_mm=1.5, close_mm=0.4),
        )
    )


@dataclass(frozen=True)
class MarkerMemory:
    """Posterior of controls and head, which a frame leaves to the next."""

    mean: Floats  # (k,)
    known: KnownControls
    head: HeadPrior


@dataclass(frozen=True)
class _LaggedEvidence:
    """Evidence that serves while derivatives are the same and markers count about alike."""

    jacobian: Jacobian
    precision: Floats  # (k, 3, 3) of the markers, in the head's axes
    evidence: Evidence


@dataclass(frozen=True)
class MarkerFit:
    """One frame of a take, fitted; ``predicted`` where nothing was seen that counts.

    One that is ``kept`` could not be fitted: the face is as in the frame before.
    """

    state: PosedFace
    placed: PlacedMarkers
    judged: JudgedFrame
    sd: Floats  # (k,) of the controls
    information: Floats  # (k,) of this frame alone, or one before whose markers counted alike
    contraction_sd: Floats  # (m,) of the muscles' contractions, (0,) of fibre muscles
    held: np.ndarray  # (m,) muscles
    predicted: bool
    kept: bool
    steps: int

    @property
    def residual_mm(self) -> Floats:
        """Return how far each point is off the fitted face's marker, (k,), NaN without one."""
        off = np.linalg.norm(self.placed.points - self.judged.points, axis=1)
        return np.asarray(off)


class MarkerTracker:
    """Fits frames in their order, ``dt`` seconds apart.

    ``prior`` is that of any pose; one of a template's shapes tells the head, too, and the jaw on
    its tracks (:class:`~.shape_regression.ShapeRegression`). ``sigma`` (k,) are standard
    deviations of the markers' places on the face, mm.
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
        self.filter = ControlFilter(prior, seconds, options.filter)
        self._contraction = Contraction.of_face(face)
        self._sigma, self.seconds, self.options = sigma, seconds, options
        self._penalties = Regulariser(
            w_a=0.0, w_v=options.w_v, w_b=0.0, prior=face.rest_pose(), w_e=options.w_e
        )
        mouth = Mouth.of(face.model)
        lips, slack = options.lips, options.lips_slack_mm
        self._contact = None if mouth is None else NearContact(face.model, mouth, lips, slack)
        self._regression: ShapeRegression | None = None
        if prior.shapes is not None:
            self._regression = ShapeRegression(face, places, prior.shapes, options.regression)
        self.begin(face.rest, None)

    def contraction_sd(self, covariance: Floats) -> Floats:
        """Return the standard deviations (m,) of contractions by the controls' covariance (q, q).

        They are NaN for muscles without fibres, and (0,) of fibre muscles.
        """
        if self._contraction is None:
            return np.zeros(0)
        own = self.face.layout["activations"]
        return self._contraction.sd(covariance[own, own])

    def begin(self, state: PosedFace, memory: MarkerMemory | None) -> None:
        """Go on from a frame: its state and what it left, None before the first."""
        options = self.options
        self.memory = memory
        self.filter.begin()
        self._corners: tuple[Jacobian, Floats] | None = None
        self._rates: tuple[PosedFace, Jacobian, Floats] | None = None
        self._spread: tuple[Jacobian, Floats, Floats] | None = None
        self._lagged: _LaggedEvidence | None = None
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
        standard deviations, as in the options where they are not finite.
        """
        options, first = self.options, self.memory is None
        precision = self._precision(sigma)
        prior, head = self._before(seen)
        state = self.tracker.state
        prediction = self._predict(prior, head)
        free = np.zeros((0, 3)) if unlabelled is None else unlabelled
        judged = judge(prediction, seen, precision, free, options.robust)
        used = precision * judged.weights[:, None]
        target = np.where(used > 0.0, judged.points, np.nan)
        term = MarkerTerm(self.places, target, used, head, options.head)
        if not used.any():
            with suppress(SolveError):  # out of reach: it stays where it is
                self.tracker.go_to(state.pose.add(prior.mean - state.pose.vector()))
            return self._leave(term, judged, prior, "predicted")
        priors: list[Prior] = [prior, self._penalties]
        try:
            if self._regression is not None:
                found = self._regression.regress(term, state)
                term = replace(term, head=found.head)
                priors += [] if found.jaw is None else [found.jaw]
            held = self._held(self._evidence_by(term).alone)
            if held.any():
                priors.append(self._hold(held, prior.mean))
            known = PriorSum(tuple(priors))
            steps = self.tracker.fit_term(term, used, known, contact=self._contact, whole=first)
        except (SolveError, np.linalg.LinAlgError):
            return self._leave(term, judged, prior, "kept")
        return self._leave(term, judged, prior, "fitted", steps)

    def place(
        self, seen: Floats, weights: Floats, near: Similarity, sigma: Floats | None = None
    ) -> PlacedMarkers:
        """Place the head anew by points ``seen`` (k, 3), the face being as it is."""
        used = weights[:, None] * self._precision(sigma)
        head = HeadPrior.diffuse(self.options.head, near)
        target = np.where(used > 0.0, seen, np.nan)
        term = MarkerTerm(self.places, target, used, head, self.options.head)
        return term.place(self.places.at(self.tracker.state.x))

    def normal(
        self,
        pose: Pose,
        head: Similarity,
        weights: Floats,
        number: int,
        sigma: Floats | None = None,
    ) -> Floats:
        """Return the normal matrix (q, q) of a pose's controls by markers with ``weights`` (k,).

        The poses come in their order; sensitivities are made anew after as many as frames take.
        """
        with suppress(SolveError):  # out of reach: as the frame before
            self.tracker.go_to(pose)
        state = self.tracker.state
        places = self.places.at(state.x)
        used = weights[:, None] * self._precision(sigma)
        options = self.options.head
        near = HeadPrior.diffuse(options, head)
        term = MarkerTerm(self.places, head(places), used, near, options)
        if number % self.options.tracking.lagged_frames == 0:
            self.tracker.relinearise(term, used)
        return self._normal(term)

    def _precision(self, sigma: Floats | None) -> Floats:
        """Return the precision (k, 3) of right points; ``sigma`` is that of :meth:`fit`."""
        noise = np.full((1, 3), self.options.noise_mm) if sigma is None else sigma
        noise = np.where(np.isfinite(noise), noise, self.options.noise_mm)
        return np.asarray(1.0 / (self._sigma[:, None] ** 2 + noise**2))

    def _before(self, seen: Floats) -> tuple[GaussianPrior, HeadPrior]:
        """Return what is probable of controls and head before a frame is looked at."""
        options, memory = self.options, self.memory
        at, weights = self.places.at(self.tracker.state.x), self._sigma**-2.0
        known = None if memory is None else memory.head
        head = HeadPrior.before_frame(known, self.seconds, at, seen, weights, options.head)
        if memory is None:
            return self.prior, head
        return self.filter.before(memory.mean, memory.known), head

    def _normal(self, term: MarkerTerm) -> Floats:
        """Return the normal matrix (q, q) of the controls where the face is."""
        placed = term.place(self.places.at(self.tracker.state.x))
        return term.normal(placed, self._by_controls())

    def _evidence_by(self, term: MarkerTerm) -> Evidence:
        """Return what a frame's markers tell: as one before while they count about alike."""
        jacobian, last, turn = self.tracker.jacobian, self._lagged, term.head.motion.rotation
        assert jacobian is not None, "made when tracking began"
        # that of one axis is not that of another once the head has turned
        precision = np.einsum("ji,kj,jm->kim", turn, term.precision, turn)
        if last is not None and last.jacobian is jacobian:
            before = last.precision
            size = np.maximum(precision, before).max(axis=(1, 2), keepdims=True)
            if np.all(np.abs(precision - before) <= self.options.alike * size):
                return last.evidence
        evidence = self.filter.evidence(self._normal(term))
        self._lagged = _LaggedEvidence(jacobian, precision, evidence)
        return evidence

    def _held(self, alone: Posterior) -> np.ndarray:
        """Return which muscles (m,) a frame does not determine."""
        known = alone.information_of(self.tracker.state.pose.layout.muscles)
        return np.asarray(known < self.options.hold_below)

    def _hold(self, held: np.ndarray, mean: Floats) -> PartPrior:
        """Return what keeps muscles at the ``mean`` (q,) that is probable before a frame."""
        places = self.tracker.state.pose.layout.muscles[held].ravel()
        weights = self.options.hold_sd**-2 * np.eye(len(places))
        return PartPrior(len(mean), places, mean[places], weights)

    def _predict(self, prior: GaussianPrior, head: HeadPrior) -> Prediction:
        """Return the markers' places in the take."""
        state, by_controls = self.tracker.state, self._by_controls()
        change = prior.mean - state.pose.vector()
        places = self.places.at(state.x) + (by_controls @ change).reshape(-1, 3)
        jacobian, last = self.tracker.jacobian, self._spread
        assert jacobian is not None, "made when tracking began"
        if last is None or last[0] is not jacobian or last[1] is not prior.covariance:
            spread = by_controls @ prior.covariance @ by_controls.T
            self._spread = last = jacobian, prior.covariance, spread
        return Prediction.of(head, self.places.centre, places, last[2])

    def _by_controls(self) -> Floats:
        """Return the derivative (3 k, q) of the markers' places in the head's frame."""
        jacobian, state = self.tracker.jacobian, self.tracker.state
        assert jacobian is not None, "made when tracking began"
        if self._corners is None or self._corners[0] is not jacobian:
            self._corners = jacobian, self.places.corners_motion(jacobian)
        # a frame ends with what the next begins with
        if self._rates is None or self._rates[0] is not state or self._rates[1] is not jacobian:
            found = self.places.motion(state.x, self._corners[1])
            self._rates = state, jacobian, found
        return self._rates[2]

    def _leave(
        self,
        term: MarkerTerm,
        judged: JudgedFrame,
        prior: GaussianPrior,
        ending: Literal["fitted", "predicted", "kept"],
        steps: int = 0,
    ) -> MarkerFit:
        """Return the frame and remember its posterior."""
        state = self.tracker.state
        placed = term.place(self.places.at(state.x))
        if ending == "kept":  # its markers determine none of the controls of another frame
            evidence = self.filter.evidence(np.zeros_like(prior.covariance))
        else:
            evidence = self._evidence_by(term)
        alone, before = evidence.alone, None if self.memory is None else self.memory.known
        known = self.filter.after(prior, before, evidence)
        head = HeadPrior(placed.head, placed.precision)
        self.memory = MarkerMemory(state.pose.vector(), known, head)
        return MarkerFit(
            state,
            placed,
            judged,
            sd=np.sqrt(np.diag(known.spread)),
            information=alone.information,
            contraction_sd=self.contraction_sd(known.spread),
            held=self._held(alone),
            predicted=ending == "predicted",
            kept=ending == "kept",
            steps=steps,
        )
