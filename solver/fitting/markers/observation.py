"""Observe labelled points of a marker system: activations, jaw and head, wrong points rejected.

A frame begins with what is probable after the one before it (:meth:`GaussianPrior.after`), which
predicts every marker's place with a spread. By that points are weighed and labels mended
(:mod:`.robust`), then the face is fitted. The posterior that comes of it is the next frame's
memory; controls that no marker determines any more keep their last value, which fades to the rest
with the prior's time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np
from typing_extensions import override

from solver.contact.mouth import Mouth
from solver.errors import SolveError
from solver.fitting.activation import ActivationOptions
from solver.fitting.contact import NearContact
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.information import Posterior, inverse_of_positive
from solver.fitting.known import KnownTerm
from solver.fitting.least_squares import StopOptions
from solver.fitting.markers.filter import (
    ControlFilter,
    Evidence,
    FilterOptions,
    KnownControls,
    is_of_same,
    with_room,
)
from solver.fitting.markers.prediction import PredictedPlaces
from solver.fitting.markers.robust import Judge, JudgedFrame, RobustOptions
from solver.fitting.markers.shape_regression import RegressionOptions, ShapeRegression
from solver.fitting.markers.term import (
    HeadOptions,
    HeadPrior,
    MarkerPlaces,
    MarkerTerm,
    PlacedMarkers,
)
from solver.fitting.objective import PartPrior, Prior, PriorSum, Regulariser
from solver.fitting.prior import GaussianPrior
from solver.fitting.sensitivity import Jacobian
from solver.fitting.tracking import Observation, Tracker
from solver.fitting.tracking.frame_solver import FrameSolver, TrackingOptions
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
    looks: int = 3  # more at a first frame, while fewer of its points are wrong by the new face
    lips: float = 2.0  # weight of every third vertex of a lip in the other, per mm^2 ...
    lips_slack_mm: float = 0.2  # ... beyond this depth
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
            # few points tell little of what a step misses: the jaw would be 2 to 10 % further off
            secants=None,
            stale_frames=15,  # covariances are made of the sensitivities, too
            corrector=CorrectorOptions(long_mm=1.5, close_mm=0.4),
            whole=ActivationOptions(15, tolerance=1e-3),
        )
    )


@dataclass(frozen=True)
class MarkerMemory:
    """Posterior of controls and head, which a frame leaves to the next."""

    mean: Floats  # (k,)
    known: KnownControls
    head: HeadPrior


@dataclass(frozen=True)
class SeenMarkers:
    """Points (k, 3) of a take's frame in its axes, mm, NaN where missing.

    ``unlabelled`` (u, 3) are points that may be any marker's; ``sigma`` (k, 3) the system's own
    standard deviations, as in the options where they are not finite; ``known`` is the term of what
    a table knows of muscles, of the weight of markers.
    """

    points: Floats
    unlabelled: Floats | None = None
    sigma: Floats | None = None
    known: KnownTerm | None = None


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

    @property
    def rejected_count(self) -> int:
        """Return how many points were taken for wrong."""
        return int((self.judged.states == "outlier").sum())


@dataclass(frozen=True)
class _Begun:
    """A frame before it is fitted: what is seen and probable of it, and what the last one left."""

    seen: SeenMarkers
    prior: GaussianPrior
    memory: MarkerMemory | None


class _Response:
    """Derivative of the markers by the controls, kept while the sensitivities stay."""

    def __init__(self, places: MarkerPlaces, jacobian: Jacobian) -> None:
        self.jacobian = jacobian
        self._places = places
        self._corners = places.corners_motion(jacobian)
        self._rates: tuple[PosedFace, Floats] | None = None
        self._spread: tuple[Floats, Floats] | None = None
        # the precision (k, 3, 3) of the markers in the head's axes, and what they then told
        self.evidence: tuple[Floats, Evidence] | None = None

    def by_controls(self, state: PosedFace) -> Floats:
        """Return the derivative (3 k, q) of the markers' places in the head's frame."""
        # a frame ends with what the next begins with
        if self._rates is None or self._rates[0] is not state:
            self._rates = state, self._places.motion(state.x, self._corners)
        return self._rates[1]

    def spread(self, state: PosedFace, covariance: Floats) -> Floats:
        """Return the covariance (3 k, 3 k) of the places by that of the controls."""
        # a steady one is the same in every frame
        if self._spread is None or self._spread[0] is not covariance:
            rates = self.by_controls(state)
            self._spread = covariance, rates @ covariance @ rates.T
        return self._spread[1]


class Markers(Observation[SeenMarkers, MarkerMemory, MarkerFit]):
    """Labelled points ``seconds`` apart: an :class:`~solver.fitting.tracking.Observation`.

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
        self.face = face
        self.places = places
        self.prior = prior
        self.tracking = options.tracking
        self.options = options
        self.seconds = seconds
        self.filter = ControlFilter(prior, seconds, options.filter)
        self._contraction = Contraction.of_face(face)
        self._sigma = sigma
        self._judge = Judge(places, options.robust, options.head)
        self._penalties = Regulariser(
            w_a=0.0, w_v=options.w_v, w_b=0.0, prior=face.rest_pose(), w_e=options.w_e
        )
        mouth = Mouth.of(face.model)
        lips = options.lips
        slack = options.lips_slack_mm
        self._contact = None if mouth is None else NearContact(face.model, mouth, lips, slack)
        self._regression: ShapeRegression | None = None
        if prior.shapes is not None:
            self._regression = ShapeRegression(face, places, prior.shapes, options.regression)
        self._last_response: _Response | None = None

    def contraction_sd(self, covariance: Floats) -> Floats:
        """Return the standard deviations (m,) of contractions by the controls' covariance (q, q).

        They are NaN for muscles without fibres, and (0,) of fibre muscles.
        """
        if self._contraction is None:
            return np.zeros(0)
        own = self.face.layout["activations"]
        return self._contraction.sd(covariance[own, own])

    @override
    def begin(self, solver: FrameSolver) -> None:
        self.filter.begin()
        unseen = np.zeros((len(self.places), 3))
        solver.relinearise(MarkerTerm(self.places, unseen, unseen), unseen)

    @override
    def fit(
        self, seen: SeenMarkers, solver: FrameSolver, memory: MarkerMemory | None
    ) -> tuple[MarkerFit, MarkerMemory]:
        at = self.places.at(solver.state.x)
        weights = self._sigma**-2.0
        options = self.options.head
        if memory is None:
            prior = with_room(self.prior, seen.known)
            head = HeadPrior.of_most(at, seen.points, weights, options)
        else:
            prior = self.filter.before(memory.mean, memory.known, seen.known)
            known = memory.head
            head = HeadPrior.before_frame(known, self.seconds, at, seen.points, weights, options)
        begun = _Begun(seen, prior, memory)
        fit, left = self._fit(begun, solver, prior, head)
        if memory is not None:
            return fit, left
        # judged from the face at rest, the points of a wide-open mouth are wrong ones
        for _ in range(self.options.looks):
            if fit.kept or not fit.rejected_count:
                break
            expected = self.prior.about(left.mean)
            head = HeadPrior.of_most(self.places.at(fit.state.x), seen.points, weights, options)
            again, more = self._fit(begun, solver, expected, head)
            steps = fit.steps + again.steps
            if again.kept or again.rejected_count > fit.rejected_count:
                fit = replace(fit, steps=steps)
                solver.state = fit.state  # it was better before
                break
            is_better = again.rejected_count < fit.rejected_count
            fit, left = replace(again, steps=steps), more
            if not is_better:
                break
        return fit, left

    def _fit(
        self, begun: _Begun, solver: FrameSolver, expected: GaussianPrior, head: HeadPrior
    ) -> tuple[MarkerFit, MarkerMemory]:
        """Fit a frame; its points are judged by the controls that are ``expected``."""
        seen = begun.seen
        prior = begun.prior
        at, spread = self._predict(expected, solver)
        precision = self._precision(seen.sigma)
        points = seen.points
        free = seen.unlabelled
        prediction = PredictedPlaces.of(head, self.places.centre, at, spread)
        judged, term = self._judge.term(head, prediction, points, precision, free)
        if not term.precision.any():
            state = solver.state
            mean = self._expect(prior, seen.known)
            with suppress(SolveError):  # out of reach: it stays where it is
                solver.go_to(state.pose.add(mean - state.pose.vector()))
            return self._leave(begun, solver, term, judged, "predicted")
        priors: list[Prior] = [prior, self._penalties]
        priors += [] if seen.known is None else [seen.known]
        try:
            if self._regression is not None:
                found = self._regression.regress(term, solver.state)
                term = replace(term, head=found.head)
                priors += [] if found.jaw is None else [found.jaw]
            held = self._held(self._evidence(solver, term, seen.known).alone, seen.known)
            if held.any():
                priors.append(self._hold(held, prior.mean))
            probable = PriorSum(tuple(priors))
            first = begun.memory is None
            steps = solver.fit(term, term.precision, probable, contact=self._contact, whole=first)
        except (SolveError, np.linalg.LinAlgError):
            return self._leave(begun, solver, term, judged, "kept")
        return self._leave(begun, solver, term, judged, "fitted", steps)

    def _expect(self, prior: GaussianPrior, known: KnownTerm | None) -> Floats:
        """Return the controls (q,) of a frame of which a table alone tells, if there is one."""
        if known is None:
            return prior.mean
        layout = self.face.layout
        pull = known.gradient(Pose.of(layout, prior.mean))
        change = inverse_of_positive(prior.precision + known.curvature) @ pull
        return layout.bounds.clip(prior.mean - change)

    def place(
        self,
        state: PosedFace,
        seen: Floats,
        weights: Floats,
        near: Similarity,
        sigma: Floats | None = None,
    ) -> PlacedMarkers:
        """Place the head anew by points ``seen`` (k, 3), the face being as it is."""
        used = weights[:, None] * self._precision(sigma)
        head = HeadPrior.diffuse(self.options.head, near)
        target = np.where(used > 0.0, seen, np.nan)
        term = MarkerTerm(self.places, target, used, head, self.options.head)
        return term.place(self.places.at(state.x))

    def normal(
        self,
        solver: FrameSolver,
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
            solver.go_to(pose)
        places = self.places.at(solver.state.x)
        used = weights[:, None] * self._precision(sigma)
        options = self.options.head
        near = HeadPrior.diffuse(options, head)
        term = MarkerTerm(self.places, head(places), used, near, options)
        if number % self.tracking.lagged_frames == 0:
            solver.relinearise(term, used)
        return self._normal(solver, term)

    def _precision(self, sigma: Floats | None) -> Floats:
        """Return the precision (k, 3) of right points, of a system's own ``sigma`` (k, 3)."""
        noise = np.full((1, 3), self.options.noise_mm) if sigma is None else sigma
        noise = np.where(np.isfinite(noise), noise, self.options.noise_mm)
        return np.asarray(1.0 / (self._sigma[:, None] ** 2 + noise**2))

    def _response(self, solver: FrameSolver) -> _Response:
        jacobian = solver.jacobian
        last = self._last_response
        assert jacobian is not None, "made when tracking began"
        if last is None or last.jacobian is not jacobian:
            last = self._last_response = _Response(self.places, jacobian)
        return last

    def _normal(self, solver: FrameSolver, term: MarkerTerm) -> Floats:
        """Return the normal matrix (q, q) of the controls where the face is."""
        state = solver.state
        placed = term.place(self.places.at(state.x))
        return term.normal(placed, self._response(solver).by_controls(state))

    def _evidence(self, solver: FrameSolver, term: MarkerTerm, known: KnownTerm | None) -> Evidence:
        """Return what a frame's markers and table tell: as one before while they count alike."""
        response = self._response(solver)
        turn = term.head.motion.rotation
        # that of one axis is not that of another once the head has turned
        precision = np.einsum("ji,kj,jm->kim", turn, term.precision, turn)
        if response.evidence is not None:
            before, evidence = response.evidence
            size = np.maximum(precision, before).max(axis=(1, 2), keepdims=True)
            alike = self.options.alike
            is_seen_alike = np.all(np.abs(precision - before) <= alike * size)
            if is_seen_alike and _is_alike(known, evidence.table, alike):
                return evidence
        evidence = self.filter.evidence(self._normal(solver, term), known)
        response.evidence = precision, evidence
        return evidence

    def _held(self, alone: Posterior, known: KnownTerm | None) -> np.ndarray:
        """Return which muscles (m,) a frame does not determine, nor a table knows."""
        muscles = self.face.layout.muscles
        held = np.asarray(alone.information_of(muscles) < self.options.hold_below)
        if known is not None:
            held &= ~known.rates[:, muscles].any(axis=(0, 2))
        return held

    def _hold(self, held: np.ndarray, mean: Floats) -> PartPrior:
        """Return what keeps muscles at the ``mean`` (q,) that is probable before a frame."""
        places = self.face.layout.muscles[held].ravel()
        weights = self.options.hold_sd**-2 * np.eye(len(places))
        return PartPrior(len(mean), places, mean[places], weights)

    def _predict(self, prior: GaussianPrior, solver: FrameSolver) -> tuple[Floats, Floats]:
        """Return the markers' places (k, 3) in the head's frame, and their covariance."""
        state = solver.state
        response = self._response(solver)
        change = prior.mean - state.pose.vector()
        moved = (response.by_controls(state) @ change).reshape(-1, 3)
        return self.places.at(state.x) + moved, response.spread(state, prior.covariance)

    def _leave(
        self,
        begun: _Begun,
        solver: FrameSolver,
        term: MarkerTerm,
        judged: JudgedFrame,
        ending: Literal["fitted", "predicted", "kept"],
        steps: int = 0,
    ) -> tuple[MarkerFit, MarkerMemory]:
        """Return the frame, and its posterior to be remembered."""
        state = solver.state
        prior = begun.prior
        known = begun.seen.known
        placed = term.place(self.places.at(state.x))
        if ending == "kept":  # its markers determine none of the controls of another frame
            evidence = self.filter.evidence(np.zeros_like(prior.covariance))
        else:
            evidence = self._evidence(solver, term, known)
        alone = evidence.alone
        before = None if begun.memory is None else begun.memory.known
        after = self.filter.after(prior, before, evidence)
        head = HeadPrior(placed.head, placed.precision)
        fit = MarkerFit(
            state,
            placed,
            judged,
            sd=np.sqrt(np.diag(after.spread)),
            information=alone.information,
            contraction_sd=self.contraction_sd(after.spread),
            held=self._held(alone, known),
            predicted=ending == "predicted",
            kept=ending == "kept",
            steps=steps,
        )
        return fit, MarkerMemory(state.pose.vector(), after, head)


def _is_alike(known: KnownTerm | None, before: KnownTerm | None, alike: float) -> bool:
    """Tell whether two tables weigh the same muscles alike, to the relative tolerance ``alike``."""
    if not is_of_same(known, before):
        return False
    if known is None or before is None:
        return True
    weight = known.sd**-2.0
    other = before.sd**-2.0
    return bool(np.all(np.abs(weight - other) <= alike * np.maximum(weight, other)))


MarkerTracker: TypeAlias = Tracker[SeenMarkers, MarkerMemory, MarkerFit]
