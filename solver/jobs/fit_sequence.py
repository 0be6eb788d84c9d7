"""The job that fits a performance: activations, jaw and head motion, frame after frame."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.errors import InputError, SolveError
from solver.fitting.activation import unseen_regulariser
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Target
from solver.fitting.sequence import Tracker, stillness
from solver.fitting.target_checks import check_held
from solver.jobs import Task
from solver.jobs.fits import Targets
from solver.jobs.sequences import (
    DECIMALS,
    UNLIKE_MM,
    FrameFitter,
    distance_figures,
    fit_frames,
    frame_numbers,
    refuse_unfitted,
    write_animated,
)
from solver.kinds.fit_sequence import FitSequence
from solver.mechanics.linear import fastest
from solver.meshio.registered import PLAUSIBLE, RegisteredScan
from solver.model import SubjectModel
from solver.progress import Step
from solver.registration.register import head_motion
from solver.rig.animation_gltf import AnimatedSkin
from solver.rig.frames import (
    ChunkOptions,
    SequenceFrame,
    Status,
    read_frames,
    sequence_report,
    write_sequence,
)
from solver.rig.pictures import SequenceShot, sequence_picture
from solver.rig.rig import Rig
from solver.scans.performance import Performance, open_performance
from solver.similarity import IDENTITY, Similarity, small_motion, weighted_motion
from solver.surface import Floats


@dataclass(frozen=True)
class FollowOptions:
    """Numbers of placing the head and fitting the face, frame by frame."""

    coverage: float = 0.1  # share of the face's points below which a frame says nothing
    still_points: int = 10  # that must be seen to tell the head's motion from the face's
    still: float = 0.05  # stillness times confidence from which a point counts for that
    restless_mm: float = 0.03  # a head that moves by more is placed, and the face fitted, again
    placings: int = 3  # of the head in a frame


FOLLOW = FollowOptions()


class Follower:
    """Fits a performance's frames in their order; one that cannot be keeps the last pose.

    ``still`` (k,) says how still each point of the face lies on the skull and asks for the head's
    rigid motion: it takes the still points from where the fitted face has them to where they were
    seen, so face and head are fitted in turns. Raises :class:`InputError`
    (``sequence.no_still_points``) if nothing of the face lies still.
    """

    def __init__(
        self,
        tracker: Tracker,
        targets: Targets,
        still: Floats | None = None,
        options: FollowOptions = FOLLOW,
    ) -> None:
        self._tracker, self.face = tracker, tracker.face
        self._targets, self._still, self._options = targets, still, options
        if still is not None and np.sum(still > options.still) < options.still_points:
            message = (
                "the head's motion cannot be told from the face's: muscles or the jaw move every "
                "point of the model's face"
            )
            raise InputError("sequence.no_still_points", message)
        self._head = IDENTITY
        self._target: Target | None = None

    def fit(self, number: int, scan: RegisteredScan) -> SequenceFrame:
        """Fit the frame ``number``, face points (k, 3) with their confidence."""
        start = time.perf_counter()
        state, head = self._tracker.state, self._head
        seen = float(np.mean(scan.confidence > 0))
        status: Status = "unseen"
        iterations = 0
        if seen >= self._options.coverage and self._sees_the_head(scan):
            try:
                iterations = self._place_and_fit(scan)
                status = "fitted"
            except SolveError:
                status = "kept"
                self._tracker.state, self._head = state, head
        return self._frame(number, status, seen, iterations, time.perf_counter() - start)

    def take_up(self, frame: SequenceFrame, scan: RegisteredScan | None) -> None:
        """Go to a frame that an earlier attempt has fitted; ``scan`` is needed for its shot."""
        if frame.status != "fitted":
            return  # and kept what the frame before had
        self._head = small_motion(frame.head)
        with suppress(SolveError):  # out of reach: the next frame begins where this one did
            self._tracker.go_to(self.face.pose_of(frame.activations, frame.jaw))
        if scan is not None:
            points = self._head.inverse()(scan.vertices)
            self._target = self._targets.of_points(points, scan.confidence)

    def skin(self) -> Floats:
        """Return the whole skin (v, 3) as it is now, without the head's motion."""
        return self.face.whole_skin(self._tracker.state.x, self._tracker.state.pose.b)

    def shot(self, frame: SequenceFrame) -> SequenceShot:
        """Return the frame that was fitted or taken up last, to be drawn."""
        assert self._target is not None, "a frame was fitted"
        skin, vertices = self.skin(), self.face.model.face
        seen, error = skin.copy(), np.full(len(skin), np.nan)
        error[vertices] = self._target.distances(skin[vertices])
        visible = np.isfinite(error[vertices])
        seen[vertices[visible]] = self._target.points[visible]
        return SequenceShot(frame, seen, skin, error)

    def _sees_the_head(self, scan: RegisteredScan) -> bool:
        if self._still is None:
            return True
        visible = np.sum(self._still * scan.confidence > self._options.still)
        return bool(visible >= self._options.still_points)

    def _place_and_fit(self, scan: RegisteredScan) -> int:
        """Fit the face with the head where it is; again if that moves the head."""
        if self._still is None:
            return self._fit(scan.vertices, scan.confidence)
        pose = self._tracker.state.pose
        iterations, before = 0, np.full_like(scan.vertices, np.inf)
        for _ in range(self._options.placings):
            self._head = self._place_head(scan, self._still)
            points = self._head.inverse()(scan.vertices)
            if np.nanmax(np.abs(points - before)) < self._options.restless_mm:
                break
            iterations += self._fit(points, scan.confidence, pose)
            before = points
        return iterations

    def _place_head(self, scan: RegisteredScan, still: Floats) -> Similarity:
        """Return the motion of the fitted face's still points to where they were seen."""
        weights = still * scan.confidence
        used = weights > self._options.still
        fitted = self.face.face_points(self._tracker.state.x)[used]
        seen, weights = scan.vertices[used], weights[used]
        roughly = weighted_motion(fitted, seen, weights)
        return roughly.then(head_motion(roughly(fitted), seen, weights))

    def _fit(self, points: Floats, confidence: Floats, before: Pose | None = None) -> int:
        self._target = self._targets.of_points(points, confidence)
        return self._tracker.fit(self._target, before)

    def _frame(
        self, number: int, status: Status, seen: float, iterations: int, seconds: float
    ) -> SequenceFrame:
        state, error = self._tracker.state, np.zeros(0)
        if status == "fitted" and self._target is not None:
            error = self._target.distances(self.face.face_points(state.x))
        return SequenceFrame(
            frame=number,
            status=status,
            activations=state.pose.a.round(DECIMALS),
            jaw=self.face.five_jaw_numbers(state.pose.b).round(DECIMALS),
            head=self._head.twist.round(DECIMALS),
            **distance_figures(error[np.isfinite(error)]),
            coverage=round(seen, 4),
            inverted=self.face.flesh.inverted(state.x),
            iterations=iterations,
            seconds=round(seconds, 4),
        )


CHUNKS = ChunkOptions(frames=30)
MOST_SHOTS = 6  # frames in the picture


class PerformanceFitter(FrameFitter[SequenceFrame]):
    """Fits and draws frames ``numbers``: all as a skin, a few as a shot."""

    def __init__(self, source: Performance, follower: Follower, numbers: range) -> None:
        self.chunks = CHUNKS
        self._source, self._follower, self._numbers = source, follower, numbers
        self._model = follower.face.model
        self.skin = AnimatedSkin(self._model.skin)
        last = len(numbers) - 1
        self._shown = set(np.linspace(0, last, MOST_SHOTS).round().astype(int).tolist())
        self.shots: list[SequenceShot] = []

    def read(self, folder: Path) -> list[SequenceFrame]:
        """See :class:`~.sequences.FrameFitter`."""
        return read_frames(folder, self._model.muscle_count)

    def take_up(self, frame: SequenceFrame, position: int) -> None:
        """See :class:`~.sequences.FrameFitter`."""
        scan = self._source.frame(frame.frame) if position in self._shown else None
        self._follower.take_up(frame, scan)

    def fit(self, number: int) -> SequenceFrame:
        """See :class:`~.sequences.FrameFitter`; raises ``performance.unlike`` at the first."""
        frame = self._follower.fit(number, self._source.frame(number))
        if number == self._numbers[0]:
            _check_likeness(self._source, frame)
        return frame

    def show(self, frame: SequenceFrame, position: int) -> None:
        """See :class:`~.sequences.FrameFitter`."""
        self.skin.add(frame, self._follower.skin())
        if position in self._shown and frame.status == "fitted":
            self.shots.append(self._follower.shot(frame))


def run(task: Task[FitSequence]) -> list[Path]:
    """Fit the frames of a performance with the S of ``rig``, each from the one before.

    Frames that are ready are in ``out/frames``; with ``resume`` those that are there already are
    kept, the face is put into their poses for the animation, and the fit goes on after them. A
    frame that cannot be fitted keeps the pose before it. Raises :class:`InputError` for what
    cannot be used, ``sequence.nothing`` if no frame could be fitted.
    """
    given, out, progress = task.options, task.out, task.progress
    performance = task.inputs["performance"]
    progress(Step("read", 0.0, message=performance.name))
    rig = Rig.load(task.inputs)
    subject = rig.model
    source = open_performance(performance, subject.skin, subject.face)
    numbers = frame_numbers(source.name, range(len(source)), given)
    if not given.head_motion:
        _check_place(source, numbers[0], subject)
    face = rig.face(given.linear_solver or fastest())
    check_held(face)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(source)}"))
    fitter = PerformanceFitter(source, _follower(face, given), numbers)
    done = fit_frames(task, numbers, fitter)
    refuse_unfitted(done, source.name)
    progress(Step("export", 0.96))
    report = sequence_report(done, given.fps, source.name)
    animated, report["files"] = write_animated(out, fitter.skin, subject, given.fps)
    contraction = Contraction.of_face(face)
    files = write_sequence(out, done, subject.muscle_names, given.fps, report, contraction)
    files += animated
    if fitter.shots:
        files.append(out / "sequence.png")
        words = "{fitted} of {frames} frames fitted, {mean_mm:.2f} mm off on average"
        detail = words.format(**report)
        sequence_picture(subject, fitter.shots, source.name, detail, files[-1])
    progress(Step("done", 1.0))
    return files


def _follower(face: Face, given: FitSequence) -> Follower:
    """Return a follower that begins at rest."""
    tracker = Tracker(
        face,
        unseen_regulariser(face),
        face.rest,
        temporal=given.temporal,
        max_iterations=given.max_iterations,
    )
    targets = Targets(face.model, given.distance)
    return Follower(tracker, targets, stillness(face) if given.head_motion else None)


def _check_place(source: Performance, number: int, model: SubjectModel) -> None:
    """Raise ``performance.misaligned`` if the head is elsewhere than in the neutral."""
    scan = source.frame(number)
    away = np.linalg.norm(scan.vertices - model.skin.vertices[model.face], axis=1)
    away = away[scan.confidence > 0]
    if len(away) and (median := float(np.median(away))) > PLAUSIBLE.median_motion_mm:
        message = (
            f"{source.name}, frame {number}: the points lie {median:.0f} mm off the neutral "
            "(median); solve the head_motion, or bring the skull where the neutral has it"
        )
        place = {"file": source.name, "frame": number}
        raise InputError("performance.misaligned", message, **place, found=median)


def _check_likeness(source: Performance, frame: SequenceFrame) -> None:
    """Raise ``performance.unlike`` if a fitted face is nowhere near what was seen."""
    if frame.mean_mm is not None and frame.mean_mm > UNLIKE_MM:
        raise InputError(
            "performance.unlike",
            f"the fitted face is {frame.mean_mm:.0f} mm off frame {frame.frame} of {source.name}: "
            "it is mirrored, another person's, or has its vertices in another order",
            file=source.name,
            frame=frame.frame,
            found_mm=frame.mean_mm,
            expected_mm=UNLIKE_MM,
        )
