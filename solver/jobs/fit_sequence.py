"""The job that fits a performance: activations, jaw and head motion, frame after frame."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from typing_extensions import override

from solver.errors import InputError, SolveError
from solver.fitting.activation import unseen_regulariser
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.fitting.known import FaceMuscles
from solver.fitting.objective import Target
from solver.fitting.target_checks import check_held
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DenseFit, DenseOptions, DensePoints, SeenPoints, stillness
from solver.fitting.tracking.frame_solver import TrackingOptions
from solver.jobs import Task
from solver.jobs.fits import Targets
from solver.jobs.sequences import (
    DECIMALS,
    UNLIKE_MM,
    FrameFitter,
    KnownFrames,
    distance_figures,
    fit_frames,
    frame_numbers,
    refuse_unfitted,
    write_animated,
)
from solver.kinds.fit_sequence import FitSequence
from solver.mechanics.linear import fastest
from solver.meshio.registered import PLAUSIBLE
from solver.model import SubjectModel
from solver.progress import Step
from solver.rig import Rig
from solver.rig.frames import (
    ChunkOptions,
    SequenceFrame,
    read_frames,
    sequence_report,
    write_sequence,
)
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.rig.pictures import SequenceShot, sequence_picture
from solver.scans.performance import Performance, open_performance
from solver.similarity import small_motion
from solver.surface import Floats, Ints

CHUNKS = ChunkOptions(frames=30)
MOST_SHOTS = 6  # frames in the picture


class PerformanceFitter(FrameFitter[SequenceFrame]):
    """Fits and draws frames ``numbers``: all as a skin, a few as a shot."""

    def __init__(
        self, source: Performance, points: DensePoints, numbers: range, known: KnownFrames
    ) -> None:
        self.chunks = CHUNKS
        self._source, self._points, self._numbers = source, points, numbers
        self._known = known
        self._tracker, self._face = Tracker(points), points.face
        self.skin = AnimatedSkin(self._face.model.skin)
        last = len(numbers) - 1
        self._shown = set(np.linspace(0, last, MOST_SHOTS).round().astype(int).tolist())
        self._target: Target | None = None  # of the frame that was fitted or taken up last
        self.shots: list[SequenceShot] = []

    @override
    def read(self, folder: Path) -> list[SequenceFrame]:
        return read_frames(folder, self._face.model.muscle_count)

    @override
    def take_up(self, frame: SequenceFrame, position: int) -> None:
        if frame.status != "fitted":
            return  # and kept what the frame before had
        self._tracker.memory = head = small_motion(frame.head)
        with suppress(SolveError):  # out of reach: the next frame begins where this one did
            self._tracker.go_to(self._face.pose_of(frame.activations, frame.jaw))
        if position in self._shown:
            scan = self._source.frame(frame.frame)
            self._target = self._points.target(head.inverse()(scan.vertices), scan.confidence)

    @override
    def fit(self, number: int) -> SequenceFrame:
        """Fit a frame; raises ``performance.unlike`` at the first."""
        start = time.perf_counter()
        scan = self._source.frame(number)
        seen = SeenPoints(scan.vertices, scan.confidence, self._known.at(number))
        found = self._tracker.step(seen)
        self._target = found.target
        frame = _frame(number, found, self._face, time.perf_counter() - start)
        if number == self._numbers[0]:
            _check_likeness(self._source, frame)
        return frame

    @override
    def show(self, frame: SequenceFrame, position: int) -> None:
        state = self._tracker.state
        skin = self._face.whole_skin(state.x, state.pose.b)
        self.skin.add(frame, skin)
        if position in self._shown and frame.status == "fitted":
            assert self._target is not None, "the frame was fitted"
            self.shots.append(_shot(frame, skin, self._target, self._face.model.face))


def _frame(number: int, fit: DenseFit, face: Face, seconds: float) -> SequenceFrame:
    """Return the record of a frame."""
    pose, error = fit.state.pose, np.zeros(0)
    if fit.target is not None:
        error = fit.target.distances(face.face_points(fit.state.x))
    return SequenceFrame(
        frame=number,
        status=fit.status,
        activations=pose.a.round(DECIMALS),
        jaw=face.five_jaw_numbers(pose.b).round(DECIMALS),
        head=fit.head.twist.round(DECIMALS),
        **distance_figures(error[np.isfinite(error)]),
        coverage=round(fit.coverage, 4),
        inverted=face.flesh.count_inverted(fit.state.x),
        iterations=fit.steps,
        seconds=round(seconds, 4),
    )


def _shot(frame: SequenceFrame, skin: Floats, target: Target, vertices: Ints) -> SequenceShot:
    """Return a frame to be drawn, with the whole skin (v, 3) and what was seen of its face."""
    seen, error = skin.copy(), np.full(len(skin), np.nan)
    error[vertices] = target.distances(skin[vertices])
    visible = np.isfinite(error[vertices])
    seen[vertices[visible]] = target.points[visible]
    return SequenceShot(frame, seen, skin, error)


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
    known = KnownFrames(task, FaceMuscles.of(face), range(len(source)), given.fps)
    fitter = PerformanceFitter(source, _points(face, given), numbers, known)
    done = fit_frames(task, numbers, fitter)
    refuse_unfitted(done, source.name)
    progress(Step("export", 0.96))
    figures, notices = known.report(done)
    for notice in notices:
        progress(Step("warning", 0.96, message=notice.message))
    report = sequence_report(done, given.fps, source.name)
    report |= figures | {"notices": [notice.as_dict() for notice in notices]}
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


def _points(face: Face, given: FitSequence) -> DensePoints:
    """Return what is seen of the face, as options have it."""
    whole = replace(TrackingOptions().whole, max_iterations=given.max_iterations)
    options = DenseOptions(temporal=given.temporal, tracking=TrackingOptions(whole=whole))
    target = Targets(face.model, given.distance).of_points
    still = stillness(face) if given.head_motion else None
    return DensePoints(face, unseen_regulariser(face), target, still, options)


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
