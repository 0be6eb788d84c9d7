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

from solver.anatomy.build import jaw_tracks
from solver.anatomy.template import Template
from solver.errors import Finding, InputError, SolveError, make_warning
from solver.fitting import prior
from solver.fitting.calibration import fibre_muscles, load_muscles, with_fibres
from solver.fitting.controls import track_block
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.markers.places import RefineOptions, refine
from solver.fitting.markers.robust import RobustOptions
from solver.fitting.markers.smooth import TracedFrame, smooth
from solver.fitting.markers.term import HeadPrior, MarkerPlaces
from solver.fitting.markers.tracker import MarkerFit, MarkerMemory, MarkerOptions, MarkerTracker
from solver.fitting.prior import GaussianPrior
from solver.fitting.strips import strip_names
from solver.fitting.target_checks import check_held
from solver.jobs import Task, hash_files
from solver.kinds.fit_markers import FitMarkers
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.jaw_tracks import nearest_jaw
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
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
from solver.scans.markers.bind import bind, count_tracks, model_face
from solver.scans.markers.faults import find_faults
from solver.scans.markers.marker_set import BoundTake, MarkerSet
from solver.scans.markers.moved import split_moved
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
    progress(Step("read", 0.0, message=task.inputs["markers"].name))
    rig, take = Rig.load(task.inputs), count_tracks(read_take(task.inputs["markers"]))
    numbers = _frame_numbers(take, given)
    rate = given.rate or (take.rate if take.rate > 0 else OPTIONS.rate)
    source = _bound(task, take, rig.model, rate)
    face, muscles, notices = _face(task, rig)
    check_held(face)
    if not task.resume:
        shutil.rmtree(out / FRAMES, ignore_errors=True)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(take)}"))
    tracker = _tracker(task, source, _prior(task, rig, face), face, rate)
    about = {
        "options": given.model_dump(mode="json", exclude={"end"}),
        "files": hash_files(task.inputs),
    }
    session = _Session(tracker, out / FRAMES, about)
    done = session.read(numbers)
    skin, view = AnimatedSkin(rig.model.skin), MarkerView(source.labels, muscles)

    def show(frame: MarkerFrame, x: Floats) -> None:
        skin.add(frame, face.whole_skin(x, _pose(face, frame).b))
        view.add(frame, tracker.places.at(x), source.points(frame.frame))

    for frame in done:
        show(frame, session.reached[frame.frame])
    for number in numbers[len(done) :]:
        done.append(session.fit(number, source))
        show(done[-1], tracker.tracker.state.x)
        part = 0.01 + 0.9 * len(done) / len(numbers)
        words = f"frame {len(done)} of {len(numbers)}"
        progress(Step("frames", part, mean_error_mm=done[-1].mean_mm, message=words))
    session.close()
    if all(frame.status != "fitted" for frame in done):
        message = f"none of the {len(done)} frames of {take.file} could be fitted"
        raise InputError("sequence.nothing", message, file=take.file)
    if given.smooth:
        progress(Step("smooth", 0.93))
        skin, view = AnimatedSkin(rig.model.skin), MarkerView(source.labels, muscles)
        done = _smoothed(tracker, done, source, show)
    progress(Step("export", 0.96))
    report = sequence_report(done, rate, take.file) | _marker_report(done, source.labels)
    report |= {"notices": [notice.as_dict() for notice in notices]}
    files = write_sequence(out, done, muscles, rate, report, take.first)
    files += [out / "markers.json"] if given.refine else []
    files.append(out / "sequence.glb")
    skin.write(files[-1], rate, take.first)
    files.append(out / VIEW_FILE)
    view.write(files[-1], rate)
    progress(Step("done", 1.0))
    return files


def _bound(task: Task[FitMarkers], take: Take, model: SubjectModel, rate: float) -> BoundTake:
    """Return the take read by its marker set; what stands still or was drawn is missing.

    A marker that moved is another one from then on.
    """
    given_set = task.inputs.get("marker_set")
    markers = bind(take, model).markers if given_set is None else MarkerSet.load(given_set)
    if markers.model_sha256 != model.sha256:
        message = "the marker set is of another model: bind it again"
        raise InputError("markers.other_model", message)
    faults = find_faults(markers.session.scale * take.positions, rate)
    positions = take.positions.copy()
    for span in faults.of("frozen", "filled"):
        positions[span.first : span.last + 1, span.marker] = np.nan
    take, markers = split_moved(
        replace(take, positions=positions), markers, faults, model_face(model)
    )
    return BoundTake(take, markers, OPTIONS.least)


def _face(task: Task[FitMarkers], rig: Rig) -> tuple[Face, tuple[str, ...], list[Finding]]:
    """Return the face that frames are fitted with, its muscles' names, and what is odd about it."""
    given, model, notices = task.options, rig.model, []
    names = tuple(model.muscle_names)
    if given.muscles == "fibre":
        face = Face(model, material=MOONEY_RIVLIN, linear=given.linear_solver)
        known = task.inputs.get("fibre_muscles")
        if known is None:
            words = "the fibre muscles are not calibrated: much of an expression is beyond them"
            notices.append(make_warning("fibres.uncalibrated", words))
        muscles = fibre_muscles(face) if known is None else load_muscles(known, face)
        face, names = with_fibres(face, muscles), strip_names(names, muscles)
    else:
        face = Face(model, rig.weights, linear=given.linear_solver or fastest())
    if given.jaw == "tracks":
        tracks = jaw_tracks(_template(task), model)
        face = face.with_jaw(tracks, track_block(tracks))
    return face, names, notices


def _template(task: Task[FitMarkers]) -> Template:
    given = task.inputs.get("template")
    return builtin_template() if given is None else Template.load(given)


def _tracker(
    task: Task[FitMarkers], source: BoundTake, known: GaussianPrior, face: Face, rate: float
) -> MarkerTracker:
    """Return the tracker of the take, its markers' places mended if that was asked for."""
    given, used = task.options, source.markers
    options = MarkerOptions(
        forgetting=given.temporal,
        hold_below=given.hold_below,
        noise_mm=given.sigma_mm,
        max_iterations=given.max_iterations,
        robust=RobustOptions(scale_mm=given.robust_mm),
    )
    if given.refine:
        task.progress(Step("places", 0.01))
        # of the whole take: places must not depend on where the fit ends
        first, last = source.frames[0], source.frames[-1]
        chosen = np.unique(np.linspace(first, last, given.refine).round().astype(int))
        frames = [source.points(number) for number in chosen.tolist()]
        apart = len(source.frames) / rate / len(chosen)
        used = refine(face, used, known, frames, apart, RefineOptions(tracking=options))
        source.save(used, task.out / "markers.json")
    sigma = np.array([marker.sigma_mm for marker in used])
    places = MarkerPlaces(face.model, used)
    return MarkerTracker(face, places, sigma, known, given.step / rate, options)


def _smoothed(
    tracker: MarkerTracker,
    frames: Sequence[MarkerFrame],
    source: BoundTake,
    show: Callable[[MarkerFrame, Floats], None],
) -> list[MarkerFrame]:
    """Return the frames after a sweep back; ``show`` gets each with its flesh.

    A point that was another label's keeps its distance of before.
    """
    face, layout, found = tracker.face, tracker.face.layout, []
    traced = [
        TracedFrame(_pose(face, each), small_motion(each.head), each.marker_weight)
        for each in frames
    ]
    for frame, after in zip(frames, smooth(tracker, traced), strict=True):
        pose = face.rest_pose().add(after.controls - layout.rest)
        with suppress(SolveError):  # out of reach: as the frame beside it
            tracker.tracker.go_to(pose)
        seen = source.points(frame.frame)
        own = (np.array(frame.marker_state) == "seen") & np.isfinite(seen).all(axis=1)
        placed = tracker.place(seen, frame.marker_weight * own, small_motion(frame.head))
        away = np.linalg.norm(placed.points - seen, axis=1)
        off = np.where(own, away, frame.marker_mm)
        found.append(
            replace(
                frame,
                **_pose_values(face, tracker.tracker.state.pose),
                **_distances(off, frame.marker_weight),
                head=placed.head.twist.round(DECIMALS),
                marker_mm=off.round(DECIMALS),
                sd=after.sd.round(DECIMALS),
                inverted=face.flesh.inverted(tracker.tracker.state.x),
            )
        )
        show(found[-1], tracker.tracker.state.x)
    return found


def _prior(task: Task[FitMarkers], rig: Rig, face: Face) -> GaussianPrior:
    """Return the prior that was asked for; raises ``markers.prior`` where there is none."""
    given, layout = task.options, face.layout
    kind = given.prior
    if kind == "none":
        return prior.from_changes(layout, [], prior.LOOSE)
    if kind == "scans":
        good = [each for each in rig.expressions if each.status != "failed"]
        if not good or face.has_own_drive:
            message = "the rig has no expressions of such muscles to make a prior from"
            raise InputError("markers.prior", message)
        free, points = FreeJaw(face.model.jaw), face.model.rest[face.model.mandible]
        poses = [Pose(each.activations, each.jaw) for each in good]
        if given.jaw == "tracks":
            size = len(face.rest_pose().b)
            jaws = [nearest_jaw(face.jaw, size, free.matrix(each.b), points) for each in poses]
            pairs = zip(poses, jaws, strict=True)
            poses = [Pose.of(layout, layout.clip(layout.join([p.a, b]))) for p, b in pairs]
        return prior.from_expressions(face, poses)
    shapes = _template(task).shapes
    if shapes is None or shapes.expressions.shape[1] != len(face.model.skin.vertices):
        message = "the template has no expressions of this skin: use the prior scans or none"
        raise InputError("markers.prior", message)
    return prior.from_shapes(face, shapes.expressions)


def _frame_numbers(take: Take, given: FitMarkers) -> range:
    """Return the numbers of the frames to be fitted, as the file counts them."""
    first, end = take.numbers.start, take.numbers.stop
    start = first if given.start is None else given.start
    stop = end if given.end is None else given.end
    numbers = range(start, stop, given.step)
    if start < first or stop > end or not numbers:
        message = (
            f"{take.file} has the frames {first} to {end - 1}: start {start} and end {stop} are "
            "not within it"
        )
        expected = {"expected": len(take), "start": start, "end": stop}
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

    def _writer_from(self, first: int) -> ChunkWriter[MarkerFrame]:
        options = ChunkOptions(self._length, np.inf)
        return ChunkWriter[MarkerFrame](self._folder, first, options, self._beside)

    def read(self, numbers: range) -> list[MarkerFrame]:
        """Return the frames that an earlier attempt left, and go on from the last."""
        states: list[Mapping[str, str]] = []
        shape = self._tracker.face.rest_pose().a.shape

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
        self._writer = self._writer_from(len(done))
        return done

    def fit(self, number: int, source: BoundTake) -> MarkerFrame:
        """Fit the frame ``number``; one that cannot be keeps the last pose."""
        start, tracker = time.perf_counter(), self._tracker
        fit = tracker.fit(source.points(number), source.unlabelled(number), source.sigma(number))
        status: Status = "kept" if fit.kept else "predicted" if fit.predicted else "fitted"
        frame = _frame(number, status, fit, tracker.face, time.perf_counter() - start)
        if self._writer.add(frame):
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
            "spread": memory.spread,
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
        covariance, spread = (unpack(stored[key], "<f8", size) for key in ("covariance", "spread"))
        memory = MarkerMemory(controls, covariance, spread, head)
        pose = face.rest_pose().add(controls - face.layout.rest)
        self._tracker.begin(_settled(face, pose, unpack(stored["x"], "<f8")), memory)

    def _trace(self, frames: Sequence[MarkerFrame]) -> None:
        """Find the flesh of frames that were fitted before, for the animation."""
        tracker = self._tracker.tracker
        for frame in frames:
            with suppress(SolveError):  # out of reach: it is shown as the one before
                tracker.go_to(_pose(tracker.face, frame))
            self.reached[frame.frame] = tracker.state.x


def _settled(face: Face, pose: Pose, x: Floats) -> PosedFace:
    return face.settle(pose, x) or face.continuation(face.rest, pose)


def _frame(number: int, status: Status, fit: MarkerFit, face: Face, seconds: float) -> MarkerFrame:
    """Return the record of a fitted frame."""
    pose, judged = fit.state.pose, fit.judged
    off = fit.residual_mm
    return MarkerFrame(
        frame=number,
        status=status,
        **_pose_values(face, pose),
        **_distances(off, judged.weights),
        head=fit.placed.head.twist.round(DECIMALS),
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
    )


def _pose_values(face: Face, pose: Pose) -> dict[str, Any]:
    """Return what a frame holds of a pose."""
    mandible = face.jaw.matrix(pose.b)
    on_tracks = not isinstance(face.jaw, FreeJaw)
    points = face.model.rest[face.model.mandible]
    jaw = (
        nearest_jaw(FreeJaw(face.model.jaw), JAW_FREEDOM, mandible, points) if on_tracks else pose.b
    )
    return {
        "activations": pose.a.round(DECIMALS),
        "jaw": jaw.round(DECIMALS),
        "tracks": pose.b.round(DECIMALS) if on_tracks else np.zeros(0),
        "mandible": mandible.round(DECIMALS),
    }


def _pose(face: Face, frame: MarkerFrame) -> Pose:
    """Return the pose that a frame holds."""
    b = frame.tracks if frame.tracks.size else frame.jaw
    return replace(face.rest_pose(), a=frame.activations, b=b)


def _distances(off: Floats, weights: Floats) -> dict[str, Any]:
    """Return figures of distances ``off`` (k,) of markers that count."""
    used = off[weights > 0.0]
    if not len(used):
        return dict.fromkeys(("mean_mm", "p95_mm", "max_mm"))
    figures = {"mean_mm": used.mean(), "p95_mm": np.percentile(used, 95), "max_mm": used.max()}
    return {name: round(float(value), 4) for name, value in figures.items()}


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
