"""Shared by jobs that fit a face frame after frame: frame numbers, resuming, the loop, figures."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from solver.errors import Finding, InputError
from solver.fitting.known import MARKERS_WORTH, FaceMuscles, KnownTerm, compare_frames
from solver.jobs import Task
from solver.kinds.fit_markers import FitMarkers
from solver.kinds.kind import SequenceOptions
from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.progress import Step
from solver.rig.frames import FRAMES, ChunkOptions, ChunkWriter, SequenceFrame
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.scans.known_activations import NOTHING, KnownCourse, KnownMuscles, read_known
from solver.surface import Floats
from solver.tracks.fit import ShapeState

DECIMALS = 9  # frames are stored as text: digits beyond say nothing
UNLIKE_MM = 5.0  # mean distance of another person's face: a fit leaves less than 2

Fitted = TypeVar("Fitted", bound=SequenceFrame)


class FrameFitter(Protocol[Fitted]):
    """Fits frames in their order, each from the one before; its face is as in the last."""

    chunks: ChunkOptions = ChunkOptions(frames=30)
    # whether a file of frames ends only where it is full, and not where a job breaks off
    whole_files: bool = False

    def read(self, folder: Path) -> list[Fitted]:
        """Return the frames that an earlier attempt left."""

    def take_up(self, frame: Fitted, position: int) -> None:
        """Go to a frame that was fitted before, at a position in the sequence."""

    def fit(self, number: int) -> Fitted:
        """Fit the frame with a number; one that cannot be keeps the pose before it."""

    def show(self, frame: Fitted, position: int) -> None:
        """Draw a frame, the face being there."""

    def beside(self) -> Mapping[str, Any]:
        """Return what a file holds beside its frames, the face being in the last."""
        return {}

    def begin_file(self) -> None:
        """Go on from what the last file of frames holds, where that is more than frames."""
        return


def fit_frames(
    task: Task[Any], numbers: range, fitter: FrameFitter[Fitted], name: str
) -> list[Fitted]:
    """Fit frames of the file ``name`` and return them; they are in ``out/frames`` as they come.

    With ``task.resume`` those that are there already are kept, and the fit goes on after them.
    Raises :class:`InputError`: ``sequence.resume`` where these are others, ``sequence.nothing`` if
    no frame could be fitted.
    """
    folder = task.out / FRAMES
    progress = task.progress
    if not task.resume:
        shutil.rmtree(folder, ignore_errors=True)
    done = fitter.read(folder)
    if [frame.frame for frame in done] != list(numbers[: len(done)]):
        message = (
            f"the {len(done)} frames that are ready were chosen with another start, end or step"
        )
        raise InputError("sequence.resume", message)
    for position, frame in enumerate(done):
        fitter.take_up(frame, position)
        fitter.show(frame, position)
        words = f"frame {position + 1} of {len(numbers)} was fitted before"
        progress(Step("frames", _part(position + 1, len(numbers)), message=words))
    if done:
        fitter.begin_file()
    writer = ChunkWriter[Fitted](folder, len(done), fitter.chunks, lambda _last: fitter.beside())
    try:
        for position in range(len(done), len(numbers)):
            frame = fitter.fit(numbers[position])
            if writer.add(frame):
                fitter.begin_file()
            done.append(frame)
            fitter.show(frame, position)
            for step in _steps(frame, position + 1, len(numbers)):
                progress(step)
    finally:
        if not fitter.whole_files or len(done) == len(numbers):
            writer.flush()
    if all(frame.status != "fitted" for frame in done):
        message = f"none of the {len(done)} frames of {name} could be fitted"
        raise InputError("sequence.nothing", message, file=name)
    return done


class KnownFrames:
    """Known activations of a take's frames by the job's table, against the fitted ones.

    Without a table that is nothing. ``frames`` are the take's, as its file counts them.
    """

    def __init__(self, task: Task[Any], muscles: FaceMuscles, frames: range, rate: float) -> None:
        self._muscles = muscles
        self._first = frames.start
        self._rate = rate
        self._course: KnownCourse | None = None
        if "activations" in task.inputs:
            table = read_known(task.inputs["activations"], muscles.names)
            muscles.check(table.names)
            self._course = table.of_take(len(frames), rate)

    def at(self, number: int) -> KnownMuscles:
        """Return what is known in a frame; the first is at 0 s."""
        if self._course is None:
            return NOTHING
        return self._course.at((number - self._first) / self._rate)

    def markers_term(self, number: int) -> KnownTerm | None:
        """Return the term of a frame of markers; None where nothing is known."""
        known = self.at(number)
        return self._muscles.term(known, MARKERS_WORTH) if len(known) else None

    def report(self, frames: Iterable[SequenceFrame]) -> tuple[dict[str, Any], list[Finding]]:
        """Return how far fitted frames and table are apart, as figures; and what is odd of it."""
        if self._course is None:
            return {}, []
        figures, findings = compare_frames(
            (frame.frame, self._muscles.compare(self.at(frame.frame), frame.activations))
            for frame in frames
            if frame.status in ("fitted", "smoothed")
        )
        return {"known": figures}, findings


def frame_numbers(name: str, frames: range, given: FitMarkers | SequenceOptions) -> range:
    """Return the numbers of the frames that options choose; ``options.frames`` if there is none.

    ``name`` is the file's, ``frames`` are the numbers that it has.
    """
    start = frames.start if given.start is None else given.start
    end = frames.stop if given.end is None else given.end
    numbers = range(start, end, given.step)
    if start < frames.start or end > frames.stop or not numbers:
        message = (
            f"{name} has the frames {frames.start} to {frames.stop - 1}: start {start} and end "
            f"{end} are not within it"
        )
        expected = {"expected": len(frames), "start": start, "end": end}
        raise InputError("options.frames", message, **expected)
    return numbers


def write_animated(
    out: Path, skin: AnimatedSkin, model: SubjectModel, fps: float, first: int = 0
) -> tuple[list[Path], dict[str, Any]]:
    """Write ``sequence.glb``, the frame ``first`` at 0 s, and with the extra ``sequence.usdc``.

    Returns them, and by their names how far they are off what was fitted, read back. Raises
    :class:`~solver.errors.SolveError` ``file.differs`` where that is too far.
    """
    files = [out / "sequence.glb"]
    figures = {files[0].name: skin.write(files[0], fps, first)}
    if find_spec("pxr") is not None:
        files.append(out / "sequence.usdc")
        usd = import_module("solver.rig.exporters.usd")
        figures[files[1].name] = usd.write_sequence(files[1], model, skin, fps)
    return files, figures


def distance_figures(distances: Floats) -> dict[str, Any]:
    """Return what a frame holds of distances, mm; None where there are none."""
    if not len(distances):
        return dict.fromkeys(("mean_mm", "p95_mm", "max_mm"))
    p95 = np.percentile(distances, 95)
    figures = {"mean_mm": distances.mean(), "p95_mm": p95, "max_mm": distances.max()}
    return {name: round(float(value), 4) for name, value in figures.items()}


def shape_controls(state: ShapeState) -> dict[str, Any]:
    """Return what a frame holds of a face that shapes drive."""
    pose = state.pose
    return {
        "activations": pose.activations.round(DECIMALS),
        "jaw": pose.jaw.round(DECIMALS),
        "weights": state.q[:-JAW_FREEDOM].round(DECIMALS),
        "jaw_on_top": state.q[-JAW_FREEDOM:].round(DECIMALS),
        "lengths": pose.lengths.round(DECIMALS),
        "inverted": state.inverted,
    }


def _part(count: int, total: int) -> float:
    """Return the part of the job that is done with so many frames."""
    return 0.01 + 0.9 * count / total


def _steps(frame: SequenceFrame, count: int, total: int) -> list[Step]:
    """Return the progress that a fitted frame is, after a warning where there is something odd."""
    done = _part(count, total)
    warnings = []
    if frame.status in ("kept", "unseen"):
        why = "hardly any of the face is seen" if frame.status == "unseen" else "it does not settle"
        warnings.append(f"frame {frame.frame} keeps the pose of the frame before: {why}")
    elif frame.mean_mm is not None and frame.mean_mm > UNLIKE_MM:
        warnings.append(f"the fitted face is {frame.mean_mm:.0f} mm off frame {frame.frame}")
    steps = [Step("warning", done, message=words) for words in warnings]
    words = f"frame {count} of {total}"
    return [*steps, Step("frames", done, mean_error_mm=frame.mean_mm, message=words)]
