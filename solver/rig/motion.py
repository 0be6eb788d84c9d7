"""Frames of a simulation: where every vertex is, what a job goes on from, and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from solver.anatomy.tetrahedra import volume_ml
from solver.errors import InputError
from solver.model import SubjectModel
from solver.rig.frames import FORMAT, FrameRecord, pack, read_chunks, unpack
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation.forces import FleshMotion
from solver.surface import Floats


@dataclass(frozen=True)
class MotionRecord(FrameRecord):
    """One frame of a simulation; ``halvings`` and ``residual`` are those of its ``Stepped``."""

    time: float  # s
    eyes: Floats  # (2, 3) rotation vectors in the head's frame, the subject's left eye first
    moved: Floats  # (p, 3) mm: the flesh's vertices off their rest, in the head's frame
    penetration_mm: float  # of skin in teeth, in other skin or in objects, at the worst
    behind_teeth: int  # number of the lips' vertices
    halvings: int
    residual: float

    ARRAYS: ClassVar[tuple[str, ...]] = (*FrameRecord.ARRAYS, "eyes")
    PACKED: ClassVar[Mapping[str, str]] = {"moved": "x"}

    @property
    def into_world(self) -> Similarity:
        """Return the head's motion into the world."""
        return small_motion(self.head)


def motion_values(scene: str, motion: FleshMotion, picture: str | None) -> dict[str, Any]:
    """Return a file's values beside its frames, the last of which ended in ``motion``.

    ``scene`` is the hash of all that is simulated, ``picture`` a JPEG of that frame in base 64.
    """
    state = {"x": pack(motion.x, "<f8"), "v": pack(motion.v, "<f8")}
    return {"scene": scene, "state": state, "picture": picture}


def read_motion(folder: Path, scene: str, rest: Floats) -> tuple[list[MotionRecord], FleshMotion]:
    """Return a simulation's frames and where they ended; none, at rest, if there is no folder.

    Raises :class:`InputError`: ``simulate.frames`` as :func:`read_chunks`,
    ``simulate.other_scene`` if the frames are another scene's.
    """
    motions = [FleshMotion(rest, np.zeros_like(rest), IDENTITY)]

    def take(values: Mapping[str, Any], frames: Sequence[MotionRecord]) -> None:
        x, v = (unpack(values["state"][name], "<f8") for name in ("x", "v"))
        motions.append(FleshMotion(x, v, frames[-1].into_world))
        if values["scene"] != scene:
            message = "the frames that are ready belong to another scene, person or rig: begin anew"
            raise InputError("simulate.other_scene", message)

    frames = read_chunks(
        folder, MotionRecord, "simulate.frames", lambda frame: frame.moved.shape == rest.shape, take
    )
    return frames, motions[-1]


def motion_report(frames: Sequence[MotionRecord], model: SubjectModel) -> dict[str, Any]:
    """Return the figures of a simulation; lengths in mm, times in s or ms, volumes in ml.

    The flesh's volume is compared with that of the ``model`` at rest.
    """
    seconds = [frame.seconds for frame in frames]
    at_rest = volume_ml(model.rest, model.tets)
    volumes = [volume_ml(model.rest + frame.moved, model.tets) for frame in frames]
    changes = [100.0 * (volume / at_rest - 1.0) for volume in volumes]
    furthest = [float(np.linalg.norm(frame.moved, axis=1).max()) for frame in frames]
    return {
        "format": FORMAT,
        "frames": len(frames),
        "duration": frames[-1].time - frames[0].time,
        "penetration_max_mm": max(frame.penetration_mm for frame in frames),
        "behind_teeth": max(frame.behind_teeth for frame in frames),
        "inverted": max(frame.inverted for frame in frames),
        "moved_max_mm": round(max(furthest), 3),
        "volume_ml": round(at_rest, 2),
        "volume_change_percent": [round(min(changes), 3), round(max(changes), 3)],
        "iterations": round(float(np.mean([frame.iterations for frame in frames])), 2),
        "halvings": sum(frame.halvings for frame in frames),
        "frame_ms": round(1e3 * float(np.median(seconds)), 1),
        "frame_max_ms": round(1e3 * max(seconds), 1),
        "seconds": round(sum(seconds), 2),
    }
