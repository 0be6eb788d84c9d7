"""Observe all of a face, each of its points where it was seen, and the head's motion if asked for.

The head takes the points that lie still on the skull from where the fitted face has them to where
they were seen, so face and head are fitted in turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from typing_extensions import override

from solver.errors import InputError, SolveError
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.known import FaceMuscles
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.recruitment import Recruitment
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.tracking import Observation
from solver.fitting.tracking.frame_solver import FrameSolver, TrackingOptions
from solver.registration.register import head_motion
from solver.scans.known_activations import NOTHING, KnownMuscles
from solver.similarity import IDENTITY, Similarity, robust_weights, weighted_motion
from solver.surface import Floats


@dataclass(frozen=True)
class DenseOptions:
    """Numbers of placing the head and fitting the face, frame by frame."""

    # weight w_t of w_t/2 |a - a_before|^2, the jaw's in the same measure
    temporal: float = 0.0
    coverage: float = 0.1  # share of the face's points below which a frame says nothing
    still_points: int = 10  # that must be seen to tell the head's motion from the face's
    still: float = 0.05  # stillness times confidence from which a point counts for that
    restless_mm: float = 0.03  # a head that moves by more is placed, and the face fitted, again
    placings: int = 3  # of the head in a frame
    tracking: TrackingOptions = field(default_factory=TrackingOptions)


@dataclass(frozen=True)
class DenseFit:
    """One frame of a performance, fitted, the ``target`` being in the skull's axes.

    ``kept`` is one that could not be, ``unseen`` one of which too little was seen: the face and the
    ``head`` are as in the frame before.
    """

    state: PosedFace
    head: Similarity  # its motion into the studio
    status: Literal["fitted", "kept", "unseen"]
    coverage: float  # share of the face's points that were seen
    steps: int = 0
    target: Target | None = None  # of a frame that was fitted


@dataclass(frozen=True)
class SeenPoints:
    """A frame: the face's points (k, 3), mm, with their confidence (k,), 0 where unseen.

    ``known`` is what a table knows of muscles in it.
    """

    vertices: Floats
    confidence: Floats
    known: KnownMuscles = NOTHING


class DensePoints(Observation[SeenPoints, Similarity, DenseFit]):
    """Points of a performance: an :class:`~.tracker.Observation`, whose memory is the head.

    A frame has the face's points with their confidence; ``target`` makes the fit's target of
    both. ``still`` (k,) says how still each point lies on the skull (:func:`stillness`) and asks
    for the head's rigid motion. ``regulariser`` is the one of muscles of which nothing is expected
    (:mod:`solver.fitting.recruitment`). Raises :class:`InputError` (``sequence.no_still_points``)
    if nothing of the face lies still.
    """

    def __init__(
        self,
        face: Face,
        regulariser: Regulariser,
        target: Callable[[Floats, Floats], Target] = Target.from_points,
        still: Floats | None = None,
        options: DenseOptions = DenseOptions(),
    ) -> None:
        self.face, self.tracking, self.target = face, options.tracking, target
        self._regulariser, self._still, self._options = regulariser, still, options
        self._recruitment, self._muscles = Recruitment.of_face(face), FaceMuscles.of(face)
        if still is not None and np.sum(still > options.still) < options.still_points:
            message = (
                "the head's motion cannot be told from the face's: muscles or the jaw move every "
                "point of the model's face"
            )
            raise InputError("sequence.no_still_points", message)

    @override
    def begin(self, solver: FrameSolver) -> None:
        """Do nothing: every frame is linearised anew."""

    @override
    def fit(
        self, seen: SeenPoints, solver: FrameSolver, memory: Similarity | None
    ) -> tuple[DenseFit, Similarity]:
        before, head = solver.state, memory or IDENTITY
        coverage = float(np.mean(seen.confidence > 0))
        if coverage < self._options.coverage or not self._sees_the_head(seen):
            return DenseFit(before, head, "unseen", coverage), head
        try:
            if self._still is None:
                target, placed = self.target(seen.vertices, seen.confidence), head
                steps = self._fit(target, solver, before.pose, seen.known)
            else:
                target, placed, steps = self._fit_in_turns(seen, self._still, solver)
        except SolveError:
            solver.state = before
            return DenseFit(before, head, "kept", coverage), head
        return DenseFit(solver.state, placed, "fitted", coverage, steps, target), placed

    def _sees_the_head(self, seen: SeenPoints) -> bool:
        if self._still is None:
            return True
        visible = np.sum(self._still * seen.confidence > self._options.still)
        return bool(visible >= self._options.still_points)

    def _fit_in_turns(
        self, seen: SeenPoints, still: Floats, solver: FrameSolver
    ) -> tuple[Target, Similarity, int]:
        """Fit the face with the head where it is; again if that moves the head."""
        pose, head = solver.state.pose, self._place_head(seen, still, solver.state)
        points = head.inverse()(seen.vertices)
        target = self.target(points, seen.confidence)
        steps = self._fit(target, solver, pose, seen.known)
        for _ in range(self._options.placings - 1):
            head = self._place_head(seen, still, solver.state)
            moved = head.inverse()(seen.vertices)
            if np.nanmax(np.abs(moved - points)) < self._options.restless_mm:
                break
            points, target = moved, self.target(moved, seen.confidence)
            steps += self._fit(target, solver, pose, seen.known)
        return target, head, steps

    def _place_head(self, seen: SeenPoints, still: Floats, state: PosedFace) -> Similarity:
        """Return the motion of the fitted face's still points to where they were seen."""
        weights = still * seen.confidence
        used = weights > self._options.still
        fitted = self.face.face_points(state.x)[used]
        there, weights = seen.vertices[used], weights[used]
        roughly = weighted_motion(fitted, there, weights)
        return roughly.then(head_motion(roughly(fitted), there, weights))

    def _fit(self, target: Target, solver: FrameSolver, before: Pose, known: KnownMuscles) -> int:
        prior = self._regulariser
        if self._recruitment is not None:
            expected = self._recruitment.of_target(target).without(self._muscles.numbers(known))
            prior = expected.regularise(prior)
        prior = self._muscles.regularise(known, prior)
        prior = prior.with_proximal_term(before, self._options.temporal)
        return solver.fit(SkinDistance(self.face, target), target.weights, prior)


@dataclass(frozen=True)
class UsualMotion:
    """A motion of the usual size that makes a point mobile."""

    mobile_mm: float = 0.4  # of a point that is half as still as the skull


def stillness(face: Face, usual: UsualMotion = UsualMotion()) -> Floats:
    """Return weights (k,) in (0, 1] of the face's points: 1 where no muscle nor the jaw moves it.

    The motion is the linear response, at rest, to usual changes of every activation and of the
    jaw, all at once and independent of each other.
    """
    sensitivity = Sensitivity(face, face.rest)
    by_pose = sensitivity.response.motions(sensitivity.pose)
    columns = (by_pose * face.layout.usual).reshape(len(by_pose), -1)
    motion = np.asarray(face.face_embedding @ columns)
    squares = np.sum(motion.reshape(len(motion), -1) ** 2, axis=1)
    return robust_weights(squares / usual.mobile_mm**2)
