"""A simulation's frames on disk: as they come, with what the next attempt needs to go on.

All files are documented in docs/guide/simulation.md.
"""

from __future__ import annotations

import base64
import csv
import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from solver.anatomy.tetrahedra import volume_ml
from solver.errors import InputError
from solver.mechanics.jaw import DEGREES_OF_FREEDOM
from solver.model import SubjectModel
from solver.rig.result import ENTRIES
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation.inertia import Motion
from solver.surface import Floats

FORMAT = 1  # of files of frames, of reports and of sequence.npz
FRAMES = "frames"  # folder of those that are ready: 000010-000019.json holds the 11th to the 20th

ARRAYS = ("activations", "jaw", "head", "eyes")


@dataclass(frozen=True)
class MotionFrame:
    """One frame of a simulation.

    frame, time
        Its number, from 0, and its time in s.
    activations, jaw
        (m, 6) and (5,), as of an expression.
    head
        (6,) rotation vector (rad) and translation (mm): the head in the world, x -> R x + t.
    eyes
        (2, 3) rotation vectors in the head's frame, the subject's left eye first.
    moved
        (p, 3) in mm: how far the flesh's vertices are off their rest, in the head's frame.
    penetration_mm, behind_teeth
        How deep skin is in teeth, in other skin or in objects, at the worst, and the number of the
        lips' vertices behind teeth, see :class:`~solver.contact.crossing.Penetration`.
    inverted
        Number of tets with det F <= 0.
    iterations, halvings, residual, seconds
        How the solve went, see :class:`~solver.simulation.simulator.Stepped`.
    """

    frame: int
    time: float
    activations: Floats
    jaw: Floats
    head: Floats
    eyes: Floats
    moved: Floats
    penetration_mm: float
    behind_teeth: int
    inverted: int
    iterations: int
    halvings: int
    residual: float
    seconds: float

    @property
    def placed(self) -> Similarity:
        """Return the head's motion into the world."""
        return small_motion(self.head)

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as JSON values; ``moved`` in single precision, packed as ``x``."""
        values = asdict(replace(self, moved=np.zeros((0, 3))))
        del values["moved"]
        for name in ARRAYS:
            values[name] = values[name].tolist()
        return {**values, "x": _pack(self.moved, "<f4")}

    @classmethod
    def of(cls, values: dict[str, Any]) -> MotionFrame:
        """Return the frame that :meth:`as_dict` gave these values of."""
        given = dict(values)
        moved = _unpack(given.pop("x"), "<f4")
        arrays = {name: np.array(given[name], np.float64) for name in ARRAYS}
        return cls(**{**given, **arrays, "moved": moved})


@dataclass(frozen=True)
class Ready:
    """The frames of a folder, and the ``motion`` that the last one ended in."""

    frames: list[MotionFrame]
    motion: Motion


def write_motion(
    folder: Path,
    frames: Sequence[MotionFrame],
    motion: Motion,
    scene: str,
    picture: bytes | None = None,
) -> Path:
    """Write frames, which follow on one another, whole or not at all.

    ``motion`` is where the last one ended, ``scene`` the hash of all that is simulated, ``picture``
    a JPEG of the last one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "format": FORMAT,
        "scene": scene,
        "frames": [frame.as_dict() for frame in frames],
        "state": {"x": _pack(motion.x, "<f8"), "v": _pack(motion.v, "<f8")},
        "picture": None if picture is None else base64.b64encode(picture).decode(),
    }
    path = folder / f"{frames[0].frame:06d}-{frames[-1].frame:06d}.json"
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    partial.replace(path)
    return path


def read_motion(folder: Path, scene: str, rest: Floats) -> Ready:
    """Return what :func:`write_motion` left in a folder; no frames, and rest, if it is not there.

    Raises :class:`InputError`: ``simulate.frames`` if there is a gap or what is no frame,
    ``simulate.other_scene`` if the frames are another scene's.
    """
    frames: list[MotionFrame] = []
    motion = Motion(rest, np.zeros_like(rest), IDENTITY)
    for path in sorted(folder.glob("*.json")):
        try:
            content = json.loads(path.read_bytes())
            if content["format"] != FORMAT:
                raise ValueError(f"their format is {content['format']}, not {FORMAT}")
            read = [MotionFrame.of(each) for each in content["frames"]]
            state = [_unpack(content["state"][name], "<f8") for name in ("x", "v")]
            motion = Motion(state[0], state[1], read[-1].placed)
            found = content["scene"]
        except (OSError, ValueError, LookupError, TypeError, zlib.error) as error:
            raise InputError(
                "simulate.frames", f"{path.name} holds no frames: {error}", file=path.name
            ) from error
        if found != scene:
            raise InputError(
                "simulate.other_scene",
                "the frames that are ready belong to another scene, person or rig: begin anew",
                file=path.name,
            )
        is_next = path.stem == f"{len(frames):06d}-{len(frames) + len(read) - 1:06d}"
        if not is_next or any(each.moved.shape != rest.shape for each in read):
            raise InputError(
                "simulate.frames",
                f"{path.name} does not follow on the {len(frames)} frames before it",
                file=path.name,
            )
        frames += read
    return Ready(frames, motion)


def _pack(values: Floats, kind: str) -> str:
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 1)).decode()


def _unpack(text: str, kind: str) -> Floats:
    content = zlib.decompress(base64.b64decode(text))
    return np.frombuffer(content, kind).reshape(-1, 3).astype(np.float64)


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
#
# All files are documented in docs/guide/sequences.md.


Status = Literal["fitted", "kept", "unseen"]


@dataclass(frozen=True)
class SequenceFrame:
    """One frame, fitted.

    frame
        Its number in the performance.
    status
        ``fitted``; ``kept``: the fit failed and the pose is the frame before's; ``unseen``: too
        little of the face was seen, the pose is kept too.
    activations, jaw
        (m, 6) and (5,), as of an expression.
    head
        (6,) rotation vector (rad) and translation (mm): the head in the studio, x -> R x + t; zero
        where it was not asked for.
    mean_mm, p95_mm, max_mm
        Distance between fit and frame over the face's points that were seen, None without any.
    coverage
        Share of the face's points that were seen.
    inverted
        Number of tets with det F <= 0.
    iterations, seconds
        How the solve went.
    """

    frame: int
    status: Status
    activations: Floats
    jaw: Floats
    head: Floats
    mean_mm: float | None
    p95_mm: float | None
    max_mm: float | None
    coverage: float
    inverted: int
    iterations: int
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as JSON values."""
        arrays = {name: getattr(self, name).tolist() for name in ("activations", "jaw", "head")}
        return {**asdict(self), **arrays}

    @classmethod
    def of(cls, values: dict[str, Any]) -> SequenceFrame:
        """Return the frame that :meth:`as_dict` gave these values of."""
        arrays = {name: np.array(values[name], float) for name in ("activations", "jaw", "head")}
        return cls(**{**values, **arrays})


def write_frames(folder: Path, first: int, frames: Sequence[SequenceFrame]) -> Path:
    """Write frames, the ``first``-th of the sequence and on, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {"format": FORMAT, "frames": [frame.as_dict() for frame in frames]}
    path = folder / f"{first:06d}-{first + len(frames) - 1:06d}.json"
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    partial.replace(path)
    return path


def read_frames(folder: Path, muscles: int) -> list[SequenceFrame]:
    """Return the frames that :func:`write_frames` left in a folder, none if it is not there.

    Raises :class:`InputError` (``sequence.frames``) if there is a gap or another model's frames.
    """
    frames: list[SequenceFrame] = []
    for path in sorted(folder.glob("*.json")):
        try:
            read = [SequenceFrame.of(each) for each in json.loads(path.read_bytes())["frames"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                "sequence.frames", f"{path.name} holds no frames: {error}", file=path.name
            ) from error
        is_next = path.stem == f"{len(frames):06d}-{len(frames) + len(read) - 1:06d}"
        if not is_next or any(each.activations.shape != (muscles, 6) for each in read):
            raise InputError(
                "sequence.frames",
                f"{path.name} does not follow on the {len(frames)} frames before it",
                file=path.name,
            )
        frames += read
    return frames


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
    jaw = [f"jaw.{number}" for number in range(1, DEGREES_OF_FREEDOM + 1)]
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
