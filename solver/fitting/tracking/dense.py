"""Observe all of a face, each of its points where it was seen, and the head's motion if asked for.

The head takes the points that lie still on the skull from where the fitted face has them to where
they were seen, so face and head are fitted in turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

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


StateT = TypeVar("StateT")


@dataclass(frozen=True)
class DenseFit(Generic[StateT]):
    """One frame of a performance, fitted, the ``target`` being in the skull's axes.

    ``kept`` is one that could not be, ``unseen`` one of which too little was seen: the face and the
    ``head`` are as in the frame before.
    """

    state: StateT
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


class HeadAndFace:
    """The points of a performance's frames, fitted in turns with the head, whatever moves the face.

    A frame has the face's points with their confidence; ``target`` makes the fit's target of
    both. ``still`` (k,) says how still each point lies on the skull (:func:`stillness`) and asks
    for the head's rigid motion. Raises :class:`InputError` (``sequence.no_still_points``)
    if nothing of the face lies still.
    """

    def __init__(
        self,
        target: Callable[[Floats, Floats], Target] = Target.from_points,
        still: Floats | None = None,
        options: DenseOptions = DenseOptions(),
    ) -> None:
        self.target = target
        self.options = options
        self._still = still
        if still is not None and np.sum(still > options.still) < options.still_points:
            message = (
                "the head's motion cannot be told from the face's: muscles or the jaw move every "
                "point of the model's face"
            )
            raise InputError("sequence.no_still_points", message)

    @property
    def places_head(self) -> bool:
        """Return whether the head's motion is asked for."""
        return self._still is not None

    def with_fixed_head(self) -> HeadAndFace:
        """Return the same points with the head where the neutral has it."""
        return HeadAndFace(self.target, None, self.options)

    def sees(self, seen: SeenPoints) -> bool:
        """Return whether a frame shows enough of the face, and of the head if that moves."""
        if coverage_of(seen) < self.options.coverage:
            return False
        if self._still is None:
            return True
        visible = np.sum(self._still * seen.confidence > self.options.still)
        return bool(visible >= self.options.still_points)

    def fit(
        self,
        seen: SeenPoints,
        head: Similarity,
        fitted: Callable[[], Floats],
        fit: Callable[[Target], int],
    ) -> tuple[Target, Similarity, int]:
        """Fit a frame; return its target, the head's motion and the steps that were taken.

        ``fitted`` gives the points (k, 3) as the face has them now, and ``fit`` moves it to a
        target. The face is fitted with the head where that is; again if that moves the head.
        """
        if self._still is None:
            target = self.target(seen.vertices, seen.confidence)
            return target, head, fit(target)
        head = self._place_head(seen, self._still, fitted())
        points = head.inverse()(seen.vertices)
        target = self.target(points, seen.confidence)
        steps = fit(target)
        for _ in range(self.options.placings - 1):
            head = self._place_head(seen, self._still, fitted())
            moved = head.inverse()(seen.vertices)
            if np.nanmax(np.abs(moved - points)) < self.options.restless_mm:
                break
            points = moved
            target = self.target(moved, seen.confidence)
            steps += fit(target)
        return target, head, steps

    def _place_head(self, seen: SeenPoints, still: Floats, fitted: Floats) -> Similarity:
        """Return the motion of the fitted face's still points to where they were seen."""
        weights = still * seen.confidence
        used = weights > self.options.still
        there = seen.vertices[used]
        weights = weights[used]
        roughly = weighted_motion(fitted[used], there, weights)
        return roughly.then(head_motion(roughly(fitted[used]), there, weights))


def coverage_of(seen: SeenPoints) -> float:
    """Return the share of the face's points that a frame shows."""
    return float(np.mean(seen.confidence > 0))


class DensePoints(Observation[SeenPoints, Similarity, DenseFit[PosedFace]]):
    """Points of a performance; the memory of this observation is the head.

    ``regulariser`` is the one of muscles of which nothing is expected
    (:mod:`solver.fitting.recruitment`).
    """

    def __init__(
        self, face: Face, regulariser: Regulariser, points: HeadAndFace | None = None
    ) -> None:
        self.face = face
        self.points = points or HeadAndFace()
        self._regulariser = regulariser
        self.tracking = self.points.options.tracking
        self._recruitment = Recruitment.of_face(face)
        self._muscles = FaceMuscles.of(face)

    @override
    def begin(self, solver: FrameSolver) -> None:
        """Do nothing: every frame is linearised anew."""

    @override
    def fit(
        self, seen: SeenPoints, solver: FrameSolver, memory: Similarity | None
    ) -> tuple[DenseFit[PosedFace], Similarity]:
        before = solver.state
        head = memory or IDENTITY
        coverage = coverage_of(seen)
        if not self.points.sees(seen):
            return DenseFit(before, head, "unseen", coverage), head

        def fit(target: Target) -> int:
            return self._fit(target, solver, before.pose, seen.known)

        try:
            target, placed, steps = self.points.fit(
                seen, head, lambda: self.face.face_points(solver.state.x), fit
            )
        except (SolveError, np.linalg.LinAlgError):
            solver.state = before
            return DenseFit(before, head, "kept", coverage), head
        return DenseFit(solver.state, placed, "fitted", coverage, steps, target), placed

    def _fit(self, target: Target, solver: FrameSolver, before: Pose, known: KnownMuscles) -> int:
        prior = self._regulariser
        if self._recruitment is not None:
            expected = self._recruitment.of_target(target).without(self._muscles.numbers(known))
            prior = expected.regularise(prior)
        prior = self._muscles.regularise(known, prior)
        prior = prior.with_proximal_term(before, self.points.options.temporal)
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
