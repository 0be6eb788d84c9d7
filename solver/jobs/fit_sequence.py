"""The job that fits a performance: muscles or shapes, jaw and head motion, frame after frame."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from solver.errors import InputError, SolveError
from solver.fitting.activation import unseen_regulariser
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.fitting.known import FaceMuscles
from solver.fitting.objective import Target
from solver.fitting.recruitment_checks import check_expected
from solver.fitting.target_checks import check_held
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import (
    DenseFit,
    DenseOptions,
    DensePoints,
    HeadAndFace,
    SeenPoints,
    stillness,
)
from solver.fitting.tracking.frame_solver import TrackingOptions
from solver.jobs import Task
from solver.jobs.fits import Targets
from solver.jobs.live_off import LiveOff
from solver.jobs.sequences import (
    DECIMALS,
    UNLIKE_MM,
    Fitted,
    FrameFitter,
    KnownFrames,
    distance_figures,
    fit_frames,
    frame_numbers,
    shape_controls,
    write_animated,
)
from solver.kinds.fit_sequence import FitSequence
from solver.mechanics.linear import fastest
from solver.meshio.registered import PLAUSIBLE
from solver.model import SubjectModel
from solver.progress import Step
from solver.rig import Rig
from solver.rig.frames import SequenceFrame, read_frames, sequence_report, write_sequence
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.rig.frames.shape_frames import ShapeFrame, read_shape_frames
from solver.rig.pictures import SequenceShot, sequence_picture
from solver.scans.performance import Performance, open_performance
from solver.similarity import small_motion
from solver.surface import Floats, Ints
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import TrackFitOptions
from solver.tracks.track import ShapeTracker

MOST_SHOTS = 6  # frames in the picture


class PerformanceFitter(FrameFitter[Fitted]):
    """Fits and draws frames ``numbers``: all as a skin, a few as a shot."""

    def __init__(self, source: Performance, model: SubjectModel, numbers: range) -> None:
        self._source = source
        self._model = model
        self._numbers = numbers
        self.skin = AnimatedSkin(model.skin)
        last = len(numbers) - 1
        self._shown = set(np.linspace(0, last, MOST_SHOTS).round().astype(int).tolist())
        self._target: Target | None = None  # of the frame that was fitted or taken up last
        self.shots: list[SequenceShot] = []

    def target_of(self, points: Floats, confidence: Floats) -> Target:
        """Return the target of the face's points (k, 3) in the skull's axes."""
        raise NotImplementedError

    def go_to(self, frame: Fitted) -> None:
        """Go to a frame that was fitted before; raises :class:`SolveError` if it cannot."""
        raise NotImplementedError

    def step(self, seen: SeenPoints, number: int) -> tuple[Fitted, Target | None]:
        """Fit the next frame; the target is that of one which could be fitted."""
        raise NotImplementedError

    def skin_now(self) -> Floats:
        """Return the whole skin (V, 3) of the last frame."""
        raise NotImplementedError

    @override
    def take_up(self, frame: Fitted, position: int) -> None:
        if frame.status != "fitted":
            return  # and kept what the frame before had
        with suppress(SolveError):  # out of reach: the next frame begins where this one did
            self.go_to(frame)
        if position in self._shown:
            scan = self._source.frame(frame.frame)
            head = small_motion(frame.head)
            self._target = self.target_of(head.inverse()(scan.vertices), scan.confidence)

    @override
    def fit(self, number: int) -> Fitted:
        """Fit a frame; raises ``performance.unlike`` at the first."""
        start = time.perf_counter()
        scan = self._source.frame(number)
        frame, self._target = self.step(SeenPoints(scan.vertices, scan.confidence), number)
        frame = replace(frame, seconds=round(time.perf_counter() - start, 4))
        if number == self._numbers[0]:
            _check_likeness(self._source, frame)
        return frame

    @override
    def show(self, frame: Fitted, position: int) -> None:
        skin = self.skin_now()
        self.skin.add(frame, skin)
        if position in self._shown and frame.status == "fitted":
            assert self._target is not None, "the frame was fitted"
            self.shots.append(_shot(frame, skin, self._target, self._model.face))


class MuscleFitter(PerformanceFitter[SequenceFrame]):
    """Fits activations and jaw, with what a table knows of them."""

    def __init__(
        self, source: Performance, points: DensePoints, numbers: range, known: KnownFrames
    ) -> None:
        super().__init__(source, points.face.model, numbers)
        self._points = points
        self._known = known
        self._tracker = Tracker(points)

    @override
    def read(self, folder: Path) -> list[SequenceFrame]:
        return read_frames(folder, self._model.muscle_count)

    @override
    def target_of(self, points: Floats, confidence: Floats) -> Target:
        return self._points.points.target(points, confidence)

    @override
    def go_to(self, frame: SequenceFrame) -> None:
        self._tracker.memory = small_motion(frame.head)
        self._tracker.go_to(self._points.face.pose_of(frame.activations, frame.jaw))

    @override
    def step(self, seen: SeenPoints, number: int) -> tuple[SequenceFrame, Target | None]:
        found = self._tracker.step(replace(seen, known=self._known.at(number)))
        face = self._points.face
        pose = found.state.pose
        figures = _figures(found, face, found.state.x)
        inverted = face.flesh.count_inverted(found.state.x)
        jaw = face.five_jaw_numbers(pose.b).round(DECIMALS)
        controls: dict[str, Any] = {
            "activations": pose.a.round(DECIMALS),
            "jaw": jaw,
            "inverted": inverted,
        }
        return SequenceFrame(frame=number, **controls, **figures), found.target

    @override
    def skin_now(self) -> Floats:
        state = self._tracker.state
        return self._points.face.whole_skin(state.x, state.pose.b)


class ShapeFitter(PerformanceFitter[ShapeFrame]):
    """Fits weights of the shapes of tracks."""

    def __init__(
        self,
        source: Performance,
        face: TrackFace,
        points: HeadAndFace,
        options: TrackFitOptions,
        numbers: range,
    ) -> None:
        super().__init__(source, face.model, numbers)
        self._face = face
        self._points = points
        self._tracker = ShapeTracker(face, points, options)

    @override
    def read(self, folder: Path) -> list[ShapeFrame]:
        return read_shape_frames(folder, len(self._face.tracks.names), self._model.muscle_count)

    @override
    def target_of(self, points: Floats, confidence: Floats) -> Target:
        return self._points.target(points, confidence)

    @override
    def go_to(self, frame: ShapeFrame) -> None:
        self._tracker.begin(frame.controls, small_motion(frame.head))

    @override
    def step(self, seen: SeenPoints, number: int) -> tuple[ShapeFrame, Target | None]:
        found = self._tracker.step(seen)
        figures = _figures(found, self._face.face, found.state.x)
        return ShapeFrame(frame=number, **shape_controls(found.state), **figures), found.target

    @override
    def skin_now(self) -> Floats:
        return self._face.skin(self._tracker.state)


def _figures(fit: DenseFit[Any], face: Face, x: Floats) -> dict[str, Any]:
    """Return what the record of a frame has beside controls; its seconds are not known yet."""
    error = np.zeros(0)
    if fit.target is not None:
        error = fit.target.distances(face.face_points(x))
    return {
        "status": fit.status,
        "head": fit.head.twist.round(DECIMALS),
        **distance_figures(error[np.isfinite(error)]),
        "coverage": round(fit.coverage, 4),
        "iterations": fit.steps,
        "seconds": 0.0,
    }


def _shot(frame: SequenceFrame, skin: Floats, target: Target, vertices: Ints) -> SequenceShot:
    """Return a frame to be drawn, with the whole skin (v, 3) and what was seen of its face."""
    seen = skin.copy()
    error = np.full(len(skin), np.nan)
    error[vertices] = target.distances(skin[vertices])
    visible = np.isfinite(error[vertices])
    seen[vertices[visible]] = target.points[visible]
    return SequenceShot(frame, seen, skin, error)


def run(task: Task[FitSequence]) -> list[Path]:
    """Fit the frames of a performance with the S of ``rig``, or its tracks, each from the last.

    Frames that are ready are in ``out/frames``; with ``resume`` those that are there already are
    kept, the face is put into their poses for the animation, and the fit goes on after them. A
    frame that cannot be fitted keeps the pose before it. Raises :class:`InputError` for what
    cannot be used, ``sequence.nothing`` if no frame could be fitted.
    """
    given = task.options
    out = task.out
    progress = task.progress
    performance = task.inputs["performance"]
    progress(Step("read", 0.0, message=performance.name))
    rig = Rig.load(task.inputs)
    subject = rig.model
    live = LiveOff(task, rig, performance)
    source = open_performance(performance, subject.skin, subject.face)
    numbers = frame_numbers(source.name, range(len(source)), given)
    if not given.head_motion:
        _check_place(source, numbers[0], subject)
    face = rig.face(given.linear_solver or fastest())
    check_held(face)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(source)}"))
    notices = check_expected(face) if given.system == "S" else []
    for notice in notices:
        progress(Step("warning", 0.01, message=notice.message))
    known = KnownFrames(task, FaceMuscles.of(face), range(len(source)), given.fps)
    fitter, beside = _fitter(task, source, face, numbers, known)
    done: list[SequenceFrame] = fit_frames(task, numbers, fitter, source.name)
    progress(Step("export", 0.96))
    figures, disagreements = known.report(done)
    for notice in disagreements:
        progress(Step("warning", 0.96, message=notice.message))
    notices += disagreements
    report = sequence_report(done, given.fps, source.name) | {"system": given.system}
    report |= figures | {"notices": [notice.as_dict() for notice in notices]}
    report |= live.report(fitter.skin.solved())
    animated, report["files"] = write_animated(out, fitter.skin, subject, given.fps)
    of_all = Contraction.of_face(face), 0, beside
    files = write_sequence(out, done, subject.muscle_names, given.fps, report, *of_all)
    files += animated
    if fitter.shots:
        files.append(out / "sequence.png")
        words = "{fitted} of {frames} frames fitted, {mean_mm:.2f} mm off on average"
        detail = words.format(**report)
        sequence_picture(subject, fitter.shots, source.name, detail, files[-1])
    progress(Step("done", 1.0))
    return files


def _fitter(
    task: Task[FitSequence], source: Performance, face: Face, numbers: range, known: KnownFrames
) -> tuple[PerformanceFitter[Any], dict[str, Any]]:
    """Return what fits frames, and the arrays that the sequence has beside theirs."""
    points = _points(face, task.options)
    if task.options.system == "S":
        dense = DensePoints(face, unseen_regulariser(face), points)
        return MuscleFitter(source, dense, numbers, known), {}
    driven = _track_face(task, face.model)
    fitter = ShapeFitter(source, driven, points, _shape_options(task.options), numbers)
    return fitter, {"shapes": driven.tracks.names}


def _track_face(task: Task[FitSequence], model: SubjectModel) -> TrackFace:
    """Return the face under the job's tracks."""
    if "activations" in task.inputs:
        message = "a table of known activations says nothing of shapes: leave it out, or fit S"
        raise InputError("options.system", message)
    tracks = MuscleTracks.load(task.inputs["tracks"], model)
    linear = task.options.linear_solver or fastest()
    return TrackFace(model, tracks, track_potentials(model), linear=linear)


def _shape_options(given: FitSequence) -> TrackFitOptions:
    options = TrackFitOptions(w_t=given.temporal)
    return replace(options, stop=replace(options.stop, iterations=given.max_iterations))


def _points(face: Face, given: FitSequence) -> HeadAndFace:
    """Return the observation of the face's points that the options ask for."""
    whole = replace(TrackingOptions().whole, max_iterations=given.max_iterations)
    options = DenseOptions(temporal=given.temporal, tracking=TrackingOptions(whole=whole))
    target = Targets(face.model, given.distance).of_points
    still = stillness(face) if given.head_motion else None
    return HeadAndFace(target, still, options)


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
