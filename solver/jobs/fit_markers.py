"""The job that fits a take of markers: activations, jaw and head, frame after frame."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.errors import InputError, SolveError
from solver.fitting import prior
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.markers.places import refine
from solver.fitting.markers.robust import RobustOptions
from solver.fitting.markers.smooth import TracedFrame, smooth
from solver.fitting.markers.term import HeadPrior, MarkerPlaces
from solver.fitting.markers.tracker import MarkerFit, MarkerMemory, MarkerOptions, MarkerTracker
from solver.fitting.prior import GaussianPrior
from solver.fitting.target_checks import check_held
from solver.jobs import Task
from solver.kinds.fit_markers import FitMarkers
from solver.mechanics.boundary import jaw_rotation
from solver.mechanics.linear import fastest
from solver.model import JawFrame
from solver.progress import Step
from solver.rig.animation_gltf import AnimatedSkin
from solver.rig.frames import (
    FRAMES,
    ChunkOptions,
    ChunkWriter,
    MarkerFrame,
    Status,
    pack,
    read_chunks,
    sequence_report,
    unpack,
    write_sequence,
)
from solver.rig.marker_view import FILE as VIEW_FILE
from solver.rig.marker_view import MarkerView
from solver.rig.rig import Rig
from solver.scans.markers.bind import bind
from solver.scans.markers.bound_take import BoundTake
from solver.scans.markers.marker_set import MarkerSet
from solver.scans.markers.take import Take, read_take
from solver.similarity import Similarity, small_motion
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template

DECIMALS = 9  # frames are stored as text: digits beyond say nothing


@dataclass(frozen=True)
class FitMarkersOptions:
    """Numbers of the job itself."""

    rate: float = 60.0  # of a take that does not say
    least: int = 4  # markers of the set that the take has to have
    # A file of frames ends where the fit begins anew from what the file holds, so that a resumed
    # job goes the same way: so many frames, fewer of a face of so many tets.
    frames: int = 60
    tets: int = 1_500_000


OPTIONS = FitMarkersOptions()


def run(task: Task[FitMarkers]) -> list[Path]:
    """Fit the frames of a take with the S of ``rig``, each from the one before.

    Frames that are ready are in ``out/frames``; with ``resume`` the fit goes on after them, to the
    same result. Without a marker set the markers are bound to the face by their names and places.
    Raises :class:`InputError` for what cannot be used, ``sequence.nothing`` if no frame could be
    fitted.
    """
    given, out, progress = task.options, task.out, task.progress
    path = task.inputs["markers"]
    progress(Step("read", 0.0, message=path.name))
    rig, take = Rig.load(task.inputs), read_take(path)
    model = rig.model
    given_set = task.inputs.get("marker_set")
    markers = bind(take, model).markers if given_set is None else MarkerSet.load(given_set)
    if markers.model_sha256 != model.sha256:
        message = "the marker set is of another model: bind it again"
        raise InputError("markers.other_model", message)
    source = BoundTake(take, markers, OPTIONS.least)
    numbers = _frame_numbers(take, given)
    rate = given.rate or (take.rate if take.rate > 0 else OPTIONS.rate)
    face = Face(model, rig.weights, linear=given.linear_solver or fastest())
    check_held(face)
    if not task.resume:
        shutil.rmtree(out / FRAMES, ignore_errors=True)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(take)}"))
    known, used = _prior(task, rig, face), source.markers
    if given.refine:
        progress(Step("places", 0.01))
        chosen = np.unique(np.linspace(0, len(numbers) - 1, given.refine).round().astype(int))
        frames = [source.points(numbers[row]) for row in chosen.tolist()]
        used = refine(face, used, known, frames, len(numbers) * given.step / rate / len(chosen))
        source.save(used, out / "markers.json")
    tracker = MarkerTracker(
        face,
        MarkerPlaces(model, used),
        np.array([marker.sigma_mm for marker in used]),
        known,
        given.step / rate,
        _options(given),
    )
    about = {
        "options": given.model_dump(mode="json", exclude={"end"}),
        "model": model.sha256,
        "markers": markers.to_document(),
    }
    session = _Session(tracker, out / FRAMES, about)
    done = session.read(numbers)
    skin, view = AnimatedSkin(model.skin), MarkerView(source.labels, model.muscle_names)

    def show(frame: MarkerFrame, x: Floats) -> None:
        skin.add(frame, face.whole_skin(x, frame.jaw))
        view.add(frame, tracker.places.at(x), source.points(frame.frame))

    for frame in done:
        show(frame, session.reached[frame.frame])
    for number in numbers[len(done) :]:
        frame = session.fit(number, source)
        done.append(frame)
        show(frame, tracker.tracker.state.x)
        part = 0.01 + 0.9 * len(done) / len(numbers)
        words = f"frame {len(done)} of {len(numbers)}"
        progress(Step("frames", part, mean_error_mm=frame.mean_mm, message=words))
    session.close()
    if all(frame.status != "fitted" for frame in done):
        message = f"none of the {len(done)} frames of {take.file} could be fitted"
        raise InputError("sequence.nothing", message, file=take.file)
    if given.smooth:
        progress(Step("smooth", 0.93))
        skin = AnimatedSkin(model.skin)
        view = MarkerView(source.labels, model.muscle_names)
        done = _smoothed(tracker, done, out, show)
    progress(Step("export", 0.96))
    fps = rate / given.step
    report = sequence_report(done, fps, take.file) | _marker_report(done, source.labels)
    files = write_sequence(out, done, model.muscle_names, fps, report)
    files += [out / "markers.json"] if given.refine else []
    files.append(out / "sequence.glb")
    skin.write(files[-1], fps)
    files.append(out / VIEW_FILE)
    view.write(files[-1], fps)
    progress(Step("done", 1.0))
    return files


def _smoothed(
    tracker: MarkerTracker,
    frames: Sequence[MarkerFrame],
    folder: Path,
    show: Callable[[MarkerFrame, Floats], None],
) -> list[MarkerFrame]:
    """Return the frames after a sweep back; ``show`` gets each with its flesh."""
    face, layout, found = tracker.face, tracker.face.layout, []
    traced = [
        TracedFrame(Pose(each.activations, each.jaw), small_motion(each.head), each.marker_weight)
        for each in frames
    ]
    for frame, after in zip(frames, smooth(tracker, traced, folder), strict=True):
        pose = face.rest_pose().add(after.controls - layout.rest)
        with suppress(SolveError):  # out of reach: as the frame beside it
            tracker.tracker.go_to(pose)
        pose = tracker.tracker.state.pose
        found.append(
            replace(
                frame,
                activations=pose.a.round(DECIMALS),
                jaw=pose.b.round(DECIMALS),
                sd=after.sd.round(DECIMALS),
                inverted=face.flesh.inverted(tracker.tracker.state.x),
                mandible=mandible_motion(face.model.jaw, pose.b).round(DECIMALS),
            )
        )
        show(found[-1], tracker.tracker.state.x)
    return found


def _options(given: FitMarkers) -> MarkerOptions:
    return MarkerOptions(
        forgetting=given.temporal,
        hold_below=given.hold_below,
        noise_mm=given.sigma_mm,
        max_iterations=given.max_iterations,
        robust=RobustOptions(scale_mm=given.robust_mm),
    )


def _prior(task: Task[FitMarkers], rig: Rig, face: Face) -> GaussianPrior:
    """Return the prior that was asked for; raises ``markers.prior`` where there is none."""
    kind, layout = task.options.prior, face.layout
    if kind == "none":
        return prior.from_changes(layout, [], prior.LOOSE)
    if kind == "scans":
        if not rig.expressions:
            raise InputError("markers.prior", "the rig has no expressions to make a prior from")
        poses = [Pose(each.activations, each.jaw).vector() for each in rig.expressions]
        return prior.from_changes(layout, [pose - layout.rest for pose in poses], prior.LOOSE)
    given = task.inputs.get("template")
    shapes = (builtin_template() if given is None else Template.load(given)).shapes
    if shapes is None or shapes.expressions.shape[1] != len(face.model.skin.vertices):
        message = "the template has no expressions of this skin: use the prior scans or none"
        raise InputError("markers.prior", message)
    return prior.from_shapes(face, shapes.expressions)


def _frame_numbers(take: Take, given: FitMarkers) -> range:
    end = len(take) if given.end is None else given.end
    numbers = range(given.start, end, given.step)
    if end > len(take) or not numbers:
        message = (
            f"{take.file} has the frames 0 to {len(take) - 1}: start {given.start} and end {end} "
            "are not within it"
        )
        expected = {"expected": len(take), "start": given.start, "end": end}
        raise InputError("options.frames", message, **expected)
    return numbers


class _Session:
    """Fits frames and writes them, each file with what the next frame begins with.

    ``about`` is of what they are, which a later attempt has to agree with.
    """

    def __init__(self, tracker: MarkerTracker, folder: Path, about: Mapping[str, Any]) -> None:
        self._tracker, self._folder = tracker, folder
        text = json.dumps(about, sort_keys=True)
        self._about = hashlib.sha256(text.encode()).hexdigest()
        self.reached: dict[int, Floats] = {}  # vertices (p, 3) of frames that were read
        tets = len(tracker.face.model.tets)
        self._length = int(np.clip(OPTIONS.tets // tets, 1, OPTIONS.frames))
        self._writer = self._writer_from(0)
        self._count = 0

    def _writer_from(self, first: int) -> ChunkWriter[MarkerFrame]:
        options = ChunkOptions(self._length, np.inf)
        return ChunkWriter[MarkerFrame](self._folder, first, options, self._beside)

    def read(self, numbers: range) -> list[MarkerFrame]:
        """Return the frames that an earlier attempt left, and go on from the last."""
        face, states = self._tracker.face, []
        shape = (face.model.muscle_count, 6)

        def take(values: Mapping[str, Any], _frames: Sequence[MarkerFrame]) -> None:
            states.append(values["state"])
            if values["about"] != self._about:
                message = "the frames that are ready are of other options, markers or another rig"
                raise InputError("sequence.resume", message)

        done = read_chunks(
            self._folder,
            MarkerFrame,
            "sequence.frames",
            lambda frame: frame.activations.shape == shape,
            take,
        )
        if [frame.frame for frame in done] != list(numbers[: len(done)]):
            message = (
                f"the {len(done)} frames that are ready were chosen with another start, end or step"
            )
            raise InputError("sequence.resume", message)
        if done:
            self._trace(done)
            self._begin(states[-1])
        self._count, self._writer = len(done), self._writer_from(len(done))
        return done

    def fit(self, number: int, source: BoundTake) -> MarkerFrame:
        """Fit the frame ``number``; one that cannot be keeps the last pose."""
        start, tracker = time.perf_counter(), self._tracker
        points = source.points(number)
        status: Status = "fitted"
        before = tracker.tracker.state, tracker.memory
        try:
            fit = tracker.fit(points, source.unlabelled(number), source.sigma(number))
        except SolveError:
            tracker.begin(*before)
            status, fit = "kept", tracker.fit(np.full_like(points, np.nan))
        if status == "fitted" and fit.predicted:
            status = "predicted"
        seconds = time.perf_counter() - start
        frame = _frame(number, status, fit, tracker.face, seconds)
        self._count += 1
        self._writer.add(frame)
        if self._count % self._length == 0:
            self._begin(self._state())
        return frame

    def close(self) -> None:
        """Write what waits."""
        self._writer.flush()

    def _beside(self, _last: MarkerFrame) -> dict[str, Any]:
        return {"about": self._about, "state": self._state()}

    def _state(self) -> dict[str, Any]:
        """Return all that the next frame begins with, exactly."""
        state, memory = self._tracker.tracker.state, self._tracker.memory
        assert memory is not None, "a frame was fitted"
        rigid = np.vstack([memory.head.motion.rotation, memory.head.motion.shift[None]])
        parts = {
            "x": state.x,
            "controls": state.pose.vector(),
            "covariance": memory.covariance,
            "head": rigid,
            "head_precision": memory.head.precision,
        }
        return {name: pack(values, "<f8") for name, values in parts.items()}

    def _begin(self, stored: Mapping[str, str]) -> None:
        """Begin anew from what :meth:`_state` gave: the same whether it was stored or not."""
        face, size = self._tracker.face, self._tracker.face.layout.size
        controls = unpack(stored["controls"], "<f8", 1).ravel()
        rigid = unpack(stored["head"], "<f8")
        head = HeadPrior(
            Similarity(1.0, rigid[:3], rigid[3]), unpack(stored["head_precision"], "<f8", 6)
        )
        memory = MarkerMemory(controls, unpack(stored["covariance"], "<f8", size), head)
        pose = face.rest_pose().add(controls - face.layout.rest)
        self._tracker.begin(_settled(face, pose, unpack(stored["x"], "<f8")), memory)

    def _trace(self, frames: Sequence[MarkerFrame]) -> None:
        """Find the flesh of frames that were fitted before, for the animation."""
        tracker = self._tracker.tracker
        for frame in frames:
            with suppress(SolveError):  # out of reach: it is shown as the one before
                tracker.go_to(Pose(frame.activations, frame.jaw))
            self.reached[frame.frame] = tracker.state.x


def _settled(face: Face, pose: Pose, x: Floats) -> PosedFace:
    return face.settle(pose, x) or face.continuation(face.rest, pose)


def _frame(number: int, status: Status, fit: MarkerFit, face: Face, seconds: float) -> MarkerFrame:
    """Return the record of a fitted frame."""
    pose, judged = fit.state.pose, fit.judged
    off = fit.residual_mm
    used = off[judged.weights > 0.0]
    figures = (used.mean(), np.percentile(used, 95), used.max()) if len(used) else (None,) * 3
    mean, p95, most = (None if each is None else round(float(each), 4) for each in figures)
    return MarkerFrame(
        frame=number,
        status=status,
        activations=pose.a.round(DECIMALS),
        jaw=pose.b.round(DECIMALS),
        head=fit.placed.head.twist.round(DECIMALS),
        mean_mm=mean,
        p95_mm=p95,
        max_mm=most,
        coverage=round(float(np.mean(judged.weights > 0.0)), 4),
        inverted=face.flesh.inverted(fit.state.x),
        iterations=fit.steps,
        seconds=round(seconds, 4),
        marker_mm=off.round(DECIMALS),
        marker_weight=judged.weights.round(DECIMALS),
        marker_state=tuple(judged.states.tolist()),
        sd=fit.sd.round(DECIMALS),
        information=fit.information.round(DECIMALS),
        held=fit.held.astype(np.float64),
        mandible=mandible_motion(face.model.jaw, pose.b).round(DECIMALS),
    )


def mandible_motion(frame: JawFrame, b: Floats) -> Floats:
    """Return the mandible's motion (4, 4) in the head's frame for b (5,)."""
    out = np.eye(4)
    out[:3, :3] = jaw_rotation(frame, b)
    out[:3, 3] = frame.origin + b[2:] @ frame.axes - out[:3, :3] @ frame.origin
    return out


def _marker_report(frames: Sequence[MarkerFrame], labels: Sequence[str]) -> dict[str, Any]:
    """Return what became of every label, and how many muscles were held; shares of frames."""
    states = np.array([frame.marker_state for frame in frames])
    off = np.array([frame.marker_mm for frame in frames])
    counted = np.array([frame.marker_weight for frame in frames]) > 0.0
    found = {}
    for column, label in enumerate(labels):
        mine = off[counted[:, column], column]
        shares = {
            state: round(float(np.mean(states[:, column] == state)), 4)
            for state in ("missing", "outlier", "swapped", "relabelled")
        }
        rms = round(float(np.sqrt(np.mean(mine**2))), 4) if len(mine) else None
        found[label] = {**shares, "rms_mm": rms}
    held = np.array([frame.held for frame in frames])
    return {"markers": found, "held": round(float(held.mean()), 4)}
