"""A simulation's frames on disk: as they come, with what the next attempt needs to go on.

All files are documented in docs/simulation.md.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.tetrahedra import volume_ml
from solver.errors import InputError
from solver.model import SubjectModel
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation.state import Motion
from solver.surface import Floats

FORMAT = 1
FRAMES = "frames"
"""The folder of frames that are ready: ``000010-000019.json`` holds the 11th to the 20th."""

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
        lips' vertices behind teeth, see :class:`~solver.contact.penetration.Penetration`.
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
        return {**values, "x": _packed(self.moved, "<f4")}

    @classmethod
    def of(cls, values: dict[str, Any]) -> MotionFrame:
        """Return the frame that :meth:`as_dict` gave these values of."""
        given = dict(values)
        moved = _unpacked(given.pop("x"), "<f4")
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
        "state": {"x": _packed(motion.x, "<f8"), "v": _packed(motion.v, "<f8")},
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
            read = [MotionFrame.of(each) for each in content["frames"]]
            state = [_unpacked(content["state"][name], "<f8") for name in ("x", "v")]
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


def _packed(values: Floats, kind: str) -> str:
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 1)).decode()


def _unpacked(text: str, kind: str) -> Floats:
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
