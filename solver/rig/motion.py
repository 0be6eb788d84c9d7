"""Frames of simulations and of fitted sequences: their records, files and figures.

All files are documented in docs/guide/simulation.md and docs/guide/sequences.md.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from solver.anatomy.tetrahedra import volume_ml
from solver.errors import InputError
from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.rig.frames import ChunkReader, FrameRecord, pack, unpack
from solver.rig.rig import ENTRIES
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation.forces import Motion
from solver.surface import Floats

FORMAT = 1  # of reports and of sequence.npz


@dataclass(frozen=True)
class MotionFrame(FrameRecord):
    """One frame of a simulation.

    time
        In s.
    eyes
        (2, 3) rotation vectors in the head's frame, the subject's left eye first.
    moved
        (p, 3) in mm: how far the flesh's vertices are off their rest, in the head's frame.
    penetration_mm, behind_teeth
        How deep skin is in teeth, in other skin or in objects, at the worst, and the number of the
        lips' vertices behind teeth, see :class:`~solver.contact.potentials.Penetration`.
    halvings, residual
        How the solve went, see :class:`~solver.simulation.simulator.Stepped`.
    """

    time: float
    eyes: Floats
    moved: Floats
    penetration_mm: float
    behind_teeth: int
    halvings: int
    residual: float

    ARRAYS: ClassVar[tuple[str, ...]] = (*FrameRecord.ARRAYS, "eyes")
    PACKED: ClassVar[Mapping[str, str]] = {"moved": "x"}

    @property
    def into_world(self) -> Similarity:
        """Return the head's motion into the world."""
        return small_motion(self.head)


@dataclass(frozen=True)
class Ready:
    """The frames of a folder, and the ``motion`` that the last one ended in."""

    frames: list[MotionFrame]
    motion: Motion


def motion_values(scene: str, motion: Motion, picture: str | None) -> dict[str, Any]:
    """Return the values beside the frames of a file.

    ``scene`` is the hash of all that is simulated, ``motion`` where the last frame ended,
    ``picture`` a JPEG of it in base 64.
    """
    state = {"x": pack(motion.x, "<f8"), "v": pack(motion.v, "<f8")}
    return {"scene": scene, "state": state, "picture": picture}


def read_motion(folder: Path, scene: str, rest: Floats) -> Ready:
    """Return the frames of a folder and where they ended; none, at rest, if it is not there.

    Raises :class:`InputError`: ``simulate.frames`` if there is a gap or what is no frame,
    ``simulate.other_scene`` if the frames are another scene's.
    """
    motions = [Motion(rest, np.zeros_like(rest), IDENTITY)]

    def take(values: Mapping[str, Any], frames: Sequence[MotionFrame]) -> None:
        state = [unpack(values["state"][name], "<f8") for name in ("x", "v")]
        motions.append(Motion(state[0], state[1], frames[-1].into_world))
        if values["scene"] != scene:
            raise InputError(
                "simulate.other_scene",
                "the frames that are ready belong to another scene, person or rig: begin anew",
            )

    reader = ChunkReader(
        MotionFrame, "simulate.frames", lambda frame: frame.moved.shape == rest.shape, take
    )
    frames = reader.read(folder)
    return Ready(frames, motions[-1])


def motion_report(frames: Sequence[MotionFrame], model: SubjectModel) -> dict[str, Any]:
    """Return the figures of a simulation; lengths in mm, times in s or ms, volumes in ml.

    The flesh's volume is compared with that of the ``model`` at rest.
    """
    seconds = [frame.seconds for frame in frames]
    at_rest = volume_ml(model.rest, model.tets)
    moved = [volume_ml(model.rest + frame.moved, model.tets) for frame in frames]
    changes = [100.0 * (volume / at_rest - 1.0) for volume in moved]
    return {
        "format": FORMAT,
        "frames": len(frames),
        "duration": frames[-1].time - frames[0].time,
        "penetration_max_mm": max(frame.penetration_mm for frame in frames),
        "behind_teeth": max(frame.behind_teeth for frame in frames),
        "inverted": max(frame.inverted for frame in frames),
        "moved_max_mm": round(max(_furthest(frame.moved) for frame in frames), 3),
        "volume_ml": round(at_rest, 2),
        "volume_change_percent": [round(min(changes), 3), round(max(changes), 3)],
        "iterations": round(float(np.mean([frame.iterations for frame in frames])), 2),
        "halvings": sum(frame.halvings for frame in frames),
        "frame_ms": round(1e3 * float(np.median(seconds)), 1),
        "frame_max_ms": round(1e3 * max(seconds), 1),
        "seconds": round(sum(seconds), 2),
    }


def _furthest(moved: Floats) -> float:
    return float(np.linalg.norm(moved, axis=1).max())


# The result of a sequence on disk: frames as they come, and what is left at the end.


Status = Literal["fitted", "kept", "unseen"]


@dataclass(frozen=True)
class SequenceFrame(FrameRecord):
    """One frame of a performance, fitted; its number is the performance's.

    The head is in the studio, zero where it was not asked for.

    status
        ``fitted``; ``kept``: the fit failed and the pose is the frame before's; ``unseen``: too
        little of the face was seen, the pose is kept too.
    mean_mm, p95_mm, max_mm
        Distance between fit and frame over the face's points that were seen, None without any.
    coverage
        Share of the face's points that were seen.
    """

    status: Status
    mean_mm: float | None
    p95_mm: float | None
    max_mm: float | None
    coverage: float


def read_frames(folder: Path, muscles: int) -> list[SequenceFrame]:
    """Return the frames of a sequence in a folder, none if it is not there.

    Raises :class:`InputError` (``sequence.frames``) if there is a gap or another model's frames.
    """
    reader = ChunkReader(
        SequenceFrame, "sequence.frames", lambda frame: frame.activations.shape == (muscles, 6)
    )
    return reader.read(folder)


def write_sequence(
    out: Path,
    frames: Sequence[SequenceFrame],
    muscles: Sequence[str],
    fps: float,
    report: dict[str, Any],
) -> list[Path]:
    """Write ``sequence.npz``, ``activations.csv`` and ``sequence.json``; returns their paths."""
    files = [out / "sequence.npz", out / "activations.csv", out / "sequence.json"]
    _write_arrays(files[0], frames, muscles, fps)
    _write_table(files[1], frames, muscles, fps)
    files[2].write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return files


def sequence_report(frames: Sequence[SequenceFrame], fps: float, name: str) -> dict[str, Any]:
    """Return the figures of a sequence; distances in mm over frames, times in seconds or ms."""
    fitted = [frame for frame in frames if frame.status == "fitted"]
    errors = [frame.mean_mm for frame in fitted if frame.mean_mm is not None]
    seconds = [frame.seconds for frame in fitted]
    return {
        "performance": name,
        "frames": len(frames),
        "fitted": len(fitted),
        "kept": _numbers(frames, "kept"),
        "unseen": _numbers(frames, "unseen"),
        "fps": fps,
        "mean_mm": _round(np.mean, errors),
        "median_mm": _round(np.median, errors),
        "p95_mm": _round(lambda values: np.percentile(values, 95), errors),
        "worst_frame": max(fitted, key=lambda frame: frame.mean_mm or 0.0).frame
        if fitted
        else None,
        "max_mm": max((frame.max_mm for frame in fitted if frame.max_mm is not None), default=None),
        "inverted": sum(frame.inverted for frame in frames),
        "iterations": _round(np.mean, [frame.iterations for frame in fitted]),
        "frame_ms": _round(np.median, [1e3 * each for each in seconds]),
        "frames_per_second": round(len(seconds) / sum(seconds), 2) if sum(seconds) else None,
    }


def _numbers(frames: Iterable[SequenceFrame], status: Status) -> list[int]:
    return [frame.frame for frame in frames if frame.status == status]


def _round(statistic: Any, values: Sequence[float]) -> float | None:
    return round(float(statistic(values)), 4) if values else None


def _write_arrays(
    path: Path, frames: Sequence[SequenceFrame], muscles: Sequence[str], fps: float
) -> None:
    def column(name: str) -> list[Any]:
        return [getattr(frame, name) for frame in frames]

    number = np.array(column("frame"), np.int64)
    with path.open("wb") as stream:
        np.savez_compressed(
            stream,
            allow_pickle=False,
            format=np.array(FORMAT),
            muscles=np.array(muscles, dtype=np.str_),
            fps=np.array(fps),
            frame=number,
            time=number / fps,
            status=np.array(column("status"), dtype=np.str_),
            activations=np.array(column("activations")),
            jaw=np.array(column("jaw")),
            head=np.array(column("head")),
            **{
                name: np.array(column(name), np.float64) for name in ("mean_mm", "p95_mm", "max_mm")
            },
            coverage=np.array(column("coverage"), np.float64),
            inverted=np.array(column("inverted"), np.int64),
            iterations=np.array(column("iterations"), np.int64),
            seconds=np.array(column("seconds"), np.float64),
        )


def _write_table(
    path: Path, frames: Sequence[SequenceFrame], muscles: Sequence[str], fps: float
) -> None:
    """Write a row a frame; spreadsheets and animation tools read it."""
    jaw = [f"jaw.{number}" for number in range(1, JAW_FREEDOM + 1)]
    head = ["head.rx", "head.ry", "head.rz", "head.tx", "head.ty", "head.tz"]
    entries = [f"{muscle}.{entry}" for muscle in muscles for entry in ENTRIES]
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["frame", "time", "status", "mean_mm", *jaw, *head, *entries])
        for frame in frames:
            values = [*frame.jaw, *frame.head, *frame.activations.ravel()]
            error = "" if frame.mean_mm is None else f"{frame.mean_mm:.4f}"
            rows.writerow(
                [frame.frame, f"{frame.frame / fps:.4f}", frame.status, error]
                + [f"{value:.6f}" for value in values]
            )
