"""The job that fits a performance: activations, jaw and head motion, frame after frame."""

from __future__ import annotations

import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, SolveError
from solver.fitting import standard
from solver.fitting.face import Face, Pose
from solver.fitting.model_checks import check_held
from solver.fitting.sequence import Tracker
from solver.fitting.stillness import stillness
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.pipeline.common import Options, check_choice, take
from solver.pipeline.follower import Follower
from solver.pipeline.targets import Distance, Targets
from solver.progress import Progress, Step, silent
from solver.rig.result import load_weights
from solver.rig.sequence import (
    FRAMES,
    SequenceFrame,
    read_frames,
    sequence_report,
    write_frames,
    write_sequence,
)
from solver.rig.sequence_gltf import AnimatedSkin
from solver.rig.sequence_picture import Shot, sequence_picture
from solver.scans.performance import Performance, open_performance
from solver.scans.plausible import MAX_MEDIAN_MOTION_MM

DEFAULTS = {
    "fps": 30.0,
    "start": 0,
    "end": None,
    "step": 1,
    "temporal": 0.0,
    "distance": "point",
    "head_motion": False,
    "max_iterations": 12,
    "linear_solver": None,
}
CHUNK_FRAMES, CHUNK_SECONDS = 30, 2.0
"""A file of frames holds so many at most, and is written at the latest after so long."""
UNLIKE_MM = 5.0
"""Mean distance that says that a performance is not this person's: a fit leaves less than 2."""
MOST_SHOTS = 6
"""Frames in the picture."""


def fit_sequence(
    model: Path,
    weights: Path,
    performance: Path,
    out: Path,
    *,
    resume: bool = False,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Fit the frames of a performance with the S of ``weights``, each from the one before.

    ``performance`` is read as :func:`~solver.scans.performance.open_performance` says. Frames that
    are ready are in ``out/frames``, 30 a file; with ``resume`` those that are there already are
    kept and the fit goes on after them. A frame that can not be fitted keeps the pose before it.

    Options: ``fps``; ``start``, ``end`` (not included; None: the last) and ``step`` choose frames;
    ``temporal`` weighs the change of the activations from frame to frame like w_a their size, 0 is
    none; ``distance`` is ``point`` or ``plane``; ``head_motion`` solves the rigid motion of the
    head; ``max_iterations`` a frame; ``linear_solver``.

    Writes ``sequence.npz``, ``activations.csv``, ``sequence.json``, ``sequence.glb`` and
    ``sequence.png``. Raises :class:`InputError` for what can not be used, ``sequence.nothing`` if
    no frame could be fitted.
    """
    given = take(options, DEFAULTS)
    check_choice(given, "distance", get_args(Distance))
    out.mkdir(parents=True, exist_ok=True)
    progress(Step("read", 0.0, message=performance.name))
    subject = SubjectModel.load(model)
    S = load_weights(weights, subject)
    source = open_performance(performance, subject.skin, subject.face)
    numbers = _chosen(source, given)
    if not given["head_motion"]:
        _check_place(source, numbers[0], subject)
    face = Face(subject, linear=given["linear_solver"] or fastest())
    check_held(face)
    if not resume:
        shutil.rmtree(out / FRAMES, ignore_errors=True)
    done = read_frames(out / FRAMES, subject.muscle_count)
    _check_same(done, numbers)
    progress(Step("read", 0.01, message=f"{len(numbers)} frames of {len(source)}"))
    follower = _follower(face, S, given, done[-1] if done else None)
    shown = set(np.linspace(0, len(numbers) - 1, MOST_SHOTS).round().astype(int).tolist())
    shots: list[Shot] = []
    animated = AnimatedSkin(subject.skin)
    chunks = _Chunks(out / FRAMES, len(done))
    try:
        for position in range(len(done), len(numbers)):
            frame = follower.fit(numbers[position], source.frame(numbers[position]))
            if not done:
                _check_likeness(source, frame)
            chunks.add(frame)
            done.append(frame)
            animated.add(frame, follower.skin())
            if position in shown and frame.status == "fitted":
                shots.append(follower.shot(frame))
            _tell(progress, frame, position + 1, len(numbers))
    finally:
        chunks.flush()
    if all(frame.status != "fitted" for frame in done):
        raise InputError(
            "sequence.nothing",
            f"none of the {len(done)} frames of {source.name} could be fitted",
            file=source.name,
        )
    progress(Step("export", 0.96))
    report = sequence_report(done, given["fps"], source.name)
    files = write_sequence(out, done, subject.muscle_names, given["fps"], report)
    files.append(out / "sequence.glb")
    animated.write(files[-1], given["fps"])
    if shots:
        files.append(out / "sequence.png")
        detail = "{fitted} of {frames} frames fitted, {mean_mm:.2f} mm off on average".format(
            **report
        )
        sequence_picture(subject, shots, source.name, detail, files[-1])
    progress(Step("done", 1.0))
    return files


def _follower(
    face: Face, S: sp.csr_array, given: dict[str, Any], last: SequenceFrame | None
) -> Follower:
    """Return what fits the frames, from rest or from the ``last`` that is ready."""
    state = face.rest_state(S)
    if last is not None:
        with suppress(SolveError):  # out of reach from rest: the next frame begins there
            state = face.move(S, state, Pose(last.activations, last.jaw))
    regulariser = standard.unseen_regulariser(face)
    tracker = Tracker(
        face,
        S,
        regulariser,
        state,
        temporal=given["temporal"],
        max_iterations=given["max_iterations"],
    )
    targets = Targets(face.model, given["distance"])
    return Follower(tracker, targets, last, stillness(face, S) if given["head_motion"] else None)


def _chosen(source: Performance, given: dict[str, Any]) -> range:
    """Return the numbers of the frames to fit."""
    end = len(source) if given["end"] is None else given["end"]
    numbers = range(given["start"], end, given["step"])
    if end > len(source) or not numbers:
        raise InputError(
            "options.frames",
            f"{source.name} has the frames 0 to {len(source) - 1}: start {given['start']} and end "
            f"{end} are not within it",
            expected=len(source),
            start=given["start"],
            end=end,
        )
    return numbers


def _check_place(source: Performance, number: int, model: SubjectModel) -> None:
    """Raise ``performance.misaligned`` if the head is elsewhere than in the neutral."""
    scan = source.frame(number)
    away = np.linalg.norm(scan.vertices - model.skin.vertices[model.face], axis=1)
    away = away[scan.confidence > 0]
    if len(away) and np.median(away) > MAX_MEDIAN_MOTION_MM:
        raise InputError(
            "performance.misaligned",
            f"{source.name}, frame {number}: the points lie {np.median(away):.0f} mm off the "
            "neutral (median); solve the head_motion, or bring the skull where the neutral has it",
            file=source.name,
            frame=number,
            found=float(np.median(away)),
        )


def _check_same(done: list[SequenceFrame], numbers: range) -> None:
    if [frame.frame for frame in done] != list(numbers[: len(done)]):
        raise InputError(
            "sequence.resume",
            f"the {len(done)} frames that are ready were chosen with another start, end or step",
        )


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


def _tell(progress: Progress, frame: SequenceFrame, count: int, total: int) -> None:
    done = 0.01 + 0.95 * count / total
    if frame.status != "fitted":
        why = "hardly any of the face is seen" if frame.status == "unseen" else "it does not settle"
        words = f"frame {frame.frame} keeps the pose of the frame before: {why}"
        progress(Step("warning", done, message=words))
    elif frame.mean_mm is not None and frame.mean_mm > UNLIKE_MM:
        words = f"the fitted face is {frame.mean_mm:.0f} mm off frame {frame.frame}"
        progress(Step("warning", done, message=words))
    words = f"frame {count} of {total}"
    progress(Step("frames", done, mean_error_mm=frame.mean_mm, message=words))


class _Chunks:
    """Writes frames into files as they come, so many at a time or after so long."""

    def __init__(self, folder: Path, first: int) -> None:
        self._folder = folder
        self._first = first
        self._frames: list[SequenceFrame] = []
        self._since = time.monotonic()

    def add(self, frame: SequenceFrame) -> None:
        self._frames.append(frame)
        if len(self._frames) == CHUNK_FRAMES or time.monotonic() - self._since > CHUNK_SECONDS:
            self.flush()

    def flush(self) -> None:
        if self._frames:
            write_frames(self._folder, self._first, self._frames)
        self._first += len(self._frames)
        self._frames, self._since = [], time.monotonic()
