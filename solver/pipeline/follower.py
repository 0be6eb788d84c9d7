"""From one frame of a performance to the next: the head is placed, the face fitted."""

from __future__ import annotations

import time

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import InputError, SolveError
from solver.fitting.face import Pose
from solver.fitting.objective import Target
from solver.fitting.sequence import Tracker
from solver.pipeline.targets import Targets
from solver.registration.stabilise import head_motion
from solver.rig.sequence import SequenceFrame, Status
from solver.rig.sequence_picture import Shot
from solver.scans.registered import RegisteredScan
from solver.similarity import IDENTITY, Similarity, weighted_motion
from solver.surface import Floats

LEAST_COVERAGE = 0.1
"""Share of the face's points below which a frame says nothing."""
LEAST_STILL = 10
"""Still points that must be seen to tell the head's motion from the face's."""
STILL = 0.05
"""Stillness, times confidence, from which a point has a say in the head's motion."""
RESTLESS_MM = 0.03
"""A head that moves by more as the face is fitted is placed, and the face fitted, again."""
PLACINGS = 3
DECIMALS = 9
"""Frames are stored as text: digits beyond say nothing."""


class Follower:
    """Fits a performance's frames in their order; one that can not be keeps the last pose.

    ``still`` (k,) says how still each point of the face lies on the skull and asks for the head's
    rigid motion: it takes the still points from where the fitted face has them to where they were
    seen, so face and head are fitted in turns. ``last`` is the frame to go on from. Raises
    :class:`InputError` (``sequence.no_still_points``) if nothing of the face lies still.
    """

    def __init__(
        self,
        tracker: Tracker,
        targets: Targets,
        last: SequenceFrame | None = None,
        still: Floats | None = None,
    ) -> None:
        self._tracker = tracker
        self._face = tracker.face
        self._targets = targets
        self._still = still
        if still is not None and np.sum(still > STILL) < LEAST_STILL:
            raise InputError(
                "sequence.no_still_points",
                "the head's motion can not be told from the face's: muscles or the jaw move every "
                "point of the model's face",
            )
        self._head = IDENTITY if last is None else _motion(last.head)
        self._target: Target | None = None

    def fit(self, number: int, scan: RegisteredScan) -> SequenceFrame:
        """Fit the frame ``number``, face points (k, 3) with their confidence."""
        start = time.perf_counter()
        state, head = self._tracker.state, self._head
        seen = np.mean(scan.confidence > 0)
        status: Status = "unseen"
        iterations = 0
        if seen >= LEAST_COVERAGE and self._sees_the_head(scan):
            try:
                iterations = self._place_and_fit(scan)
                status = "fitted"
            except SolveError:
                status = "kept"
                self._tracker.state, self._head = state, head
        return self._frame(number, status, float(seen), iterations, time.perf_counter() - start)

    def skin(self) -> Floats:
        """Return the whole skin (v, 3) as it is now, without the head's motion."""
        state = self._tracker.state
        return self._face.whole_skin(state.x, state.pose.b)

    def shot(self, frame: SequenceFrame) -> Shot:
        """Return the frame that was fitted last, to be drawn."""
        assert self._target is not None, "a frame was fitted"
        skin, vertices = self.skin(), self._face.model.face
        seen, error = skin.copy(), np.full(len(skin), np.nan)
        error[vertices] = self._target.distances(skin[vertices])
        visible = np.isfinite(error[vertices])
        seen[vertices[visible]] = self._target.points[visible]
        return Shot(frame, seen, skin, error)

    def _sees_the_head(self, scan: RegisteredScan) -> bool:
        if self._still is None:
            return True
        return bool(np.sum(self._still * scan.confidence > STILL) >= LEAST_STILL)

    def _place_and_fit(self, scan: RegisteredScan) -> int:
        """Fit the face with the head where it is; again if that moves the head."""
        if self._still is None:
            return self._fit(scan.vertices, scan.confidence)
        pose = self._tracker.state.pose
        iterations, before = 0, np.full_like(scan.vertices, np.inf)
        for _ in range(PLACINGS):
            self._head = self._placed(scan, self._still)
            points = self._head.inverse()(scan.vertices)
            if np.nanmax(np.abs(points - before)) < RESTLESS_MM:
                break
            iterations += self._fit(points, scan.confidence, pose)
            before = points
        return iterations

    def _placed(self, scan: RegisteredScan, still: Floats) -> Similarity:
        """Return the motion of the fitted face's still points to where they were seen."""
        weights = still * scan.confidence
        used = weights > STILL
        fitted = self._face.face_points(self._tracker.state.x)[used]
        seen, weights = scan.vertices[used], weights[used]
        roughly = weighted_motion(fitted, seen, weights)
        return roughly.then(head_motion(roughly(fitted), seen, weights))

    def _fit(self, points: Floats, confidence: Floats, before: Pose | None = None) -> int:
        self._target = self._targets.of_points(points, confidence)
        return self._tracker.fit(self._target, before)

    def _frame(
        self, number: int, status: Status, seen: float, iterations: int, seconds: float
    ) -> SequenceFrame:
        state = self._tracker.state
        mean = p95 = greatest = None
        if status == "fitted" and self._target is not None:
            error = self._target.distances(self._face.face_points(state.x))
            error = error[np.isfinite(error)]
            mean, p95 = round(float(error.mean()), 4), round(float(np.percentile(error, 95)), 4)
            greatest = round(float(error.max()), 4)
        return SequenceFrame(
            frame=number,
            status=status,
            activations=state.pose.a.round(DECIMALS),
            jaw=state.pose.b.round(DECIMALS),
            head=_six(self._head).round(DECIMALS),
            mean_mm=mean,
            p95_mm=p95,
            max_mm=greatest,
            coverage=round(seen, 4),
            inverted=self._face.flesh.inverted(state.x),
            iterations=iterations,
            seconds=round(seconds, 4),
        )


def _motion(six: Floats) -> Similarity:
    return Similarity(1.0, Rotation.from_rotvec(six[:3]).as_matrix(), six[3:])


def _six(motion: Similarity) -> Floats:
    return np.concatenate([Rotation.from_matrix(motion.rotation).as_rotvec(), motion.shift])
