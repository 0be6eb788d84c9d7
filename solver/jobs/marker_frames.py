"""Frames of a take of markers in a job: fitted, resumed to the same result, smoothed, counted."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from solver.errors import Finding, InputError, SolveError
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.markers.filter import KnownControls
from solver.fitting.markers.observation import MarkerMemory, Markers, MarkerTracker, SeenMarkers
from solver.fitting.markers.smooth import SmoothFrame, TracedFrame, smooth
from solver.fitting.markers.term import HeadPrior
from solver.fitting.tracking import Tracker
from solver.jobs.marker_verdict import judge_fit
from solver.jobs.sequences import DECIMALS, FrameFitter, KnownFrames, distance_figures
from solver.rig.frames import ChunkOptions, MarkerFrame, Status, pack, read_chunks, unpack
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.rig.frames.read_back import Comparison
from solver.scans.markers.places.marker_set import BoundTake
from solver.scans.markers.signal.motion import rms_of_seen
from solver.similarity import Similarity, small_motion
from solver.storage import read_container, write_container
from solver.surface import Floats


class TakeDrawing:
    """Collects frames for the animation and for the page."""

    def __init__(self, markers: Markers, source: BoundTake, muscles: Sequence[str]) -> None:
        self._markers = markers
        self._source = source
        self.skin = AnimatedSkin(markers.face.model.skin)
        self.view = MarkerView(source.labels, muscles)

    def add(self, frame: MarkerFrame, x: Floats) -> None:
        """Take a frame whose flesh is at ``x`` (p, 3)."""
        face = self._markers.face
        places = self._markers.places
        self.skin.add(frame, face.whole_skin(x, pose_of(face, frame).b))
        self.view.add(frame, places.at(x), self._source.frame(frame.frame).points)


class TakeFitter(FrameFitter[MarkerFrame]):
    """Fits frames of a take.

    Each file of frames holds what the next begins with, so that a job that was killed comes to the
    same. ``about`` describes what the frames are of, which a later attempt has to agree with.
    """

    whole_files = True

    def __init__(
        self,
        tracker: MarkerTracker,
        source: BoundTake,
        drawing: TakeDrawing,
        about: Mapping[str, Any],
        frames: int,
        known: KnownFrames,
    ) -> None:
        self.chunks = ChunkOptions(frames, np.inf)
        self._tracker = tracker
        self._source = source
        self._drawing = drawing
        self._known = known
        text = json.dumps(about, sort_keys=True)
        self._about = hashlib.sha256(text.encode()).hexdigest()
        self._stored: Mapping[str, str] = {}

    @override
    def read(self, folder: Path) -> list[MarkerFrame]:
        shape = self._tracker.face.rest_pose().a.shape
        layout = self._tracker.face.layout

        def take(values: Mapping[str, Any], _frames: Sequence[MarkerFrame]) -> None:
            self._stored = values["state"]
            controls = unpack(self._stored["controls"], "<f8", 1)
            if values["about"] != self._about or len(controls) != layout.size:
                message = "the frames that are ready are of other options, markers or another rig"
                raise InputError("sequence.resume", message)

        return read_chunks(
            folder,
            MarkerFrame,
            "sequence.frames",
            lambda frame: frame.activations.shape == shape,
            take,
        )

    @override
    def take_up(self, frame: MarkerFrame, position: int) -> None:
        with suppress(SolveError):  # out of reach: it is shown as the one before
            self._tracker.go_to(pose_of(self._tracker.face, frame))

    @override
    def fit(self, number: int) -> MarkerFrame:
        start = time.perf_counter()
        face = self._tracker.face
        seen = self._source.frame(number)
        known = self._known.markers_term(number)
        fit = self._tracker.step(SeenMarkers(seen.points, seen.unlabelled, seen.sigma, known))
        status: Status = "kept" if fit.kept else "predicted" if fit.predicted else "fitted"
        judged = fit.judged
        exchanged = seen.exchanged & (judged.states == "seen")
        off = fit.residual_mm
        return MarkerFrame(
            frame=number,
            status=status,
            **_pose_values(face, fit.state.pose),
            **distance_figures(off[judged.weights > 0.0]),
            head=fit.placed.head.twist.round(DECIMALS),
            coverage=round(float(np.mean(judged.weights > 0.0)), 4),
            inverted=face.flesh.count_inverted(fit.state.x),
            iterations=fit.steps,
            seconds=round(time.perf_counter() - start, 4),
            marker_mm=off.round(DECIMALS),
            marker_weight=judged.weights.round(DECIMALS),
            marker_state=tuple(np.where(exchanged, "swapped", judged.states).tolist()),
            sd=fit.sd.round(DECIMALS),
            information=fit.information.round(DECIMALS),
            contraction_sd=fit.contraction_sd.round(DECIMALS),
            held=fit.held.astype(np.float64),
        )

    @override
    def show(self, frame: MarkerFrame, position: int) -> None:
        self._drawing.add(frame, self._tracker.state.x)

    @override
    def beside(self) -> dict[str, Any]:
        """Return all that the next frame begins with, exactly."""
        state = self._tracker.state
        memory = self._tracker.memory
        assert memory is not None, "a frame was fitted"
        rigid = np.vstack([memory.head.motion.rotation, memory.head.motion.shift[None]])
        parts = {
            "x": state.x,
            "controls": state.pose.vector(),
            "covariance": memory.known.covariance,
            "spread": memory.known.spread,
            "head": rigid,
            "head_precision": memory.head.precision,
        }
        self._stored = {name: pack(values, "<f8") for name, values in parts.items()}
        return {"about": self._about, "state": self._stored}

    @override
    def begin_file(self) -> None:
        """Go on from the last file, in the same way whether it was read or written."""
        stored = self._stored
        face = self._tracker.face
        controls = unpack(stored["controls"], "<f8", 1).ravel()
        rigid = unpack(stored["head"], "<f8")
        head = HeadPrior(
            Similarity(1.0, rigid[:3], rigid[3]), unpack(stored["head_precision"], "<f8", 6)
        )
        size = face.layout.size
        covariance, spread = (unpack(stored[key], "<f8", size) for key in ("covariance", "spread"))
        memory = MarkerMemory(controls, KnownControls(covariance, spread), head)
        pose = face.rest_pose().add(controls - face.layout.rest)
        x = unpack(stored["x"], "<f8")
        state = face.settle(pose, x) or face.continuation(face.rest, pose)
        self._tracker.begin(state, memory)


def _pose_values(face: Face, pose: Pose) -> dict[str, Any]:
    """Return what a frame holds of a pose."""
    mandible = face.jaw.matrix(pose.b)
    on_tracks = not face.joint.is_free
    return {
        "activations": pose.a.round(DECIMALS),
        "jaw": face.five_jaw_numbers(pose.b).round(DECIMALS),
        "tracks": pose.b.round(DECIMALS) if on_tracks else np.zeros(0),
        "mandible": mandible.round(DECIMALS),
    }


def pose_of(face: Face, frame: MarkerFrame) -> Pose:
    """Return the pose that a frame holds, within the face's bounds whatever was rounded."""
    layout = face.layout
    b = frame.tracks if frame.tracks.size else frame.jaw
    return Pose.of(layout, layout.bounds.clip(layout.join([frame.activations, b])))


def smooth_frames(
    markers: Markers,
    frames: Sequence[MarkerFrame],
    source: BoundTake,
    known: KnownFrames,
    show: Callable[[MarkerFrame, Floats], None],
) -> list[MarkerFrame]:
    """Return the frames after a sweep back; ``show`` gets each with its flesh."""
    face = markers.face
    layout = markers.face.layout
    found = []
    traced = [
        TracedFrame(
            pose_of(face, each),
            small_motion(each.head),
            each.marker_weight,
            source.frame(each.frame).sigma,
            known.markers_term(each.frame),
        )
        for each in frames
    ]
    swept = smooth(markers, traced)
    tracker = Tracker(markers)
    for frame, after in zip(frames, swept, strict=True):
        pose = face.rest_pose().add(after.controls - layout.rest)
        with suppress(SolveError):  # out of reach: as the frame beside it
            tracker.go_to(pose)
        found.append(_smooth_frame(markers, tracker.state, frame, source, after))
        show(found[-1], tracker.state.x)
    return found


def _smooth_frame(
    markers: Markers, state: PosedFace, frame: MarkerFrame, source: BoundTake, after: SmoothFrame
) -> MarkerFrame:
    """Return a frame with the pose of ``state``, and the head and distances that come of it."""
    bound = source.frame(frame.frame)
    seen = bound.points
    states = np.array(frame.marker_state)
    own = (states == "seen") & np.isfinite(seen).all(axis=1)
    weights = frame.marker_weight * own
    head = small_motion(frame.head)
    placed = markers.place(state, seen, weights, head, bound.sigma)
    off = np.linalg.norm(placed.points - seen, axis=1)
    # a label that was given another's point has the one next to its marker
    others = np.concatenate([seen, bound.unlabelled])
    others = others[np.isfinite(others).all(axis=1)]
    for label in np.flatnonzero(np.isin(states, ("swapped", "relabelled"))):
        off[label] = np.linalg.norm(others - placed.points[label], axis=1).min()
    return replace(
        frame,
        **_pose_values(markers.face, state.pose),
        **distance_figures(off[frame.marker_weight > 0.0]),
        status="fitted" if frame.status == "fitted" else "smoothed",
        head=placed.head.twist.round(DECIMALS),
        marker_mm=off.round(DECIMALS),
        sd=after.sd.round(DECIMALS),
        contraction_sd=after.contraction_sd.round(DECIMALS),
        inverted=markers.face.flesh.count_inverted(state.x),
    )


def marker_report(
    frames: Sequence[MarkerFrame], labels: Sequence[str], notices: Sequence[Finding] = ()
) -> dict[str, Any]:
    """Return what became of every label and of the take, and how many muscles were held.

    Shares are of frames; ``notices`` count in the verdict.
    """
    states = np.array([frame.marker_state for frame in frames])
    off = np.array([frame.marker_mm for frame in frames])
    counted = np.array([frame.marker_weight for frame in frames]) > 0.0
    found = {}
    for column, label in enumerate(labels):
        shares = {
            state: round(float(np.mean(states[:, column] == state)), 4)
            for state in ("missing", "outlier", "swapped", "relabelled")
        }
        kept = off[counted[:, column], column]
        found[label] = {**shares, "rms_mm": _rms(kept), "rms_all_mm": _rms(off[:, column])}
    held = np.array([frame.held for frame in frames])
    numbers = [frame.frame for frame in frames]
    judged = judge_fit(labels, numbers, states, off, notices)
    return {**judged, "markers": found, "held": round(float(held.mean()), 4)}


def _rms(distances: Floats) -> float | None:
    """Return the root mean square of what is not NaN, None if nothing is."""
    return round(rms_of_seen(distances), 4) if np.isfinite(distances).any() else None


# ``markers.bin``: where a fitted take's markers are and were seen, for a page that plays it, mm in
# the head's frame (docs/guide/rig-view.md).


VIEW_FILE = "markers.bin"
FARTHEST = float(np.finfo(np.float16).max)  # mm that a point is off at most: what its bits hold
STATES = ("seen", "missing", "outlier", "swapped", "relabelled")


class MarkerView:
    """Collects frames of k markers and m muscles, to be written together."""

    def __init__(self, labels: Sequence[str], muscles: Sequence[str]) -> None:
        self._labels = list(labels)
        self._muscles = list(muscles)
        self._places: list[Floats] = []
        self._off: list[Floats] = []
        self._frames: list[MarkerFrame] = []

    def add(self, frame: MarkerFrame, places: Floats, seen: Floats) -> None:
        """Add a frame: ``places`` (k, 3) of the fitted face, points (k, 3) seen in the studio.

        A point that was seen nowhere is NaN.
        """
        back = small_motion(frame.head).inverse()
        self._places.append(places)
        self._off.append(back(seen) - places)
        self._frames.append(frame)

    def write(self, path: Path, fps: float) -> dict[str, Any]:
        """Write the file; returns how far its places, read back, are off, by frame and marker."""
        states = np.array([[STATES.index(each) for each in f.marker_state] for f in self._frames])
        header = {
            "labels": self._labels,
            "muscles": self._muscles,
            "states": list(STATES),
            "numbers": [frame.frame for frame in self._frames],
            "status": [frame.status for frame in self._frames],
            "fps": fps,
        }
        arrays: dict[str, np.ndarray] = {
            "places": np.array(self._places, np.float32),
            "off": np.clip(np.array(self._off), -FARTHEST, FARTHEST).astype(np.float16),
            "state": states.astype(np.uint8),
            "held": np.array([frame.held for frame in self._frames]).astype(np.uint8),
        }
        write_container(path, header, arrays)
        found = Comparison(path.name)
        stored = read_container(path).arrays["places"]
        for frame, shown, wanted in zip(self._frames, stored, self._places, strict=True):
            found.add(frame.frame, shown, wanted)
        return found.figures()
