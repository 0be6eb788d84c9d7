"""Shared by jobs with a scene: the person that it is about, and the playing of its frames."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from solver.animation import PosedFrame
from solver.errors import SolveError
from solver.jobs import Task
from solver.kinds.scene_edits import FatEntry
from solver.neck.anatomy import BODIES
from solver.neck.skin import two_bones
from solver.progress import ProgressCallback, Step, part_of, silent
from solver.rig import Rig
from solver.rig.frames import FRAMES, ChunkOptions, ChunkWriter
from solver.rig.frames.animation import (
    NO_ARRAYS,
    Filming,
    MotionRecord,
    check_video,
    motion_report,
    motion_values,
    read_motion,
    write_animation,
)
from solver.rig.frames.joints import Joints
from solver.rig.frames.skin_basis import Singles
from solver.rig.neck_picture import NeckShot, draw_neck
from solver.scene import Stage
from solver.scene.document import document_of
from solver.scene.neck import CarriedHead
from solver.scene.places import Places
from solver.simulation import Stepped
from solver.simulation.forces import Drive, FleshMotion
from solver.storage import hash_files
from solver.surface import Floats


def read_person(task: Task[Any]) -> tuple[Rig, Places]:
    """Return the person of a scene; raises as its files' readers, and ``scene.template``.

    Fat without a map is told as a warning where the template does not place its compartments.
    """
    task.progress(Step("read", 0.0, message=task.inputs["rig"].name))
    rig = Rig.load(task.inputs)
    places = Places.of(rig.model, task.inputs.get("template"), task.captures)
    fat = (edit for edit in task.options.scene.edits if isinstance(edit, FatEntry))
    if any(edit.map is None for edit in fat) and (message := places.without_compartments):
        task.progress(Step("warning", 0.0, message=message))
    return rig, places


def read_player(task: Task[Any]) -> tuple[Rig, Places]:
    """Return the person of a scene that is played, as :func:`read_person`.

    Raises, besides, ``options.video`` where a video is asked for and there is no codec.
    """
    if task.options.video:
        check_video()
    return read_person(task)


def fingerprint(task: Task[Any]) -> str:
    """Return the hash of a task's scene and of all files that it is played with."""
    files = {**task.inputs, **{f"asset {name}": path for name, path in task.captures.items()}}
    content = [document_of(task.options.scene), hash_files(files)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


CHUNKS = ChunkOptions(frames=10)
NECK_PICTURE = "neck.png"
READ = 0.02  # share of a job after which its inputs are read
CARRIED = 0.1  # share of the playing after which the motion of a neck is known
EXPORT = 0.9  # share after which its files are written


@dataclass(frozen=True)
class PictureOptions:
    """Pictures beside the frames."""

    size: tuple[int, int] = (240, 300)  # pixels
    quality: int = 85  # of the JPEG, at most 95
    seconds: float = 10.0  # a file has one if none had for so long


def play(
    stage: Stage,
    out: Path,
    scene: str,
    progress: ProgressCallback = silent,
    *,
    resume: bool = False,
) -> list[MotionRecord]:
    """Simulate all frames of a stage and return them; they are in ``out/frames`` as they come.

    ``scene`` is the hash of what is simulated. With ``resume`` the simulation goes on after the
    frames that are there. Raises :class:`~solver.errors.SolveError` (``simulate.*``) with the
    ``frame`` that could not be reached; those before it stay.
    """
    if not resume:
        shutil.rmtree(out / FRAMES, ignore_errors=True)
    if stage.neck is not None:
        progress = part_of(progress, CARRIED)
        for notice in stage.neck.notices:
            progress(Step("warning", 0.0, message=notice.message))
    done, motion = read_motion(out / FRAMES, scene, stage.model.rest)
    times = stage.drives.times
    beside = _Beside(scene, stage, motion)
    chunks = ChunkWriter(out / FRAMES, len(done), CHUNKS, beside)
    before = float(times[len(done) - 1]) if done else None
    drive = None if before is None else stage.drive(before, stage.drives(before))
    try:
        for number in range(len(done), len(times)):
            moment = float(times[number])
            pose = stage.drives(moment)
            goal = stage.drive(moment, pose)
            try:
                stepped = _reach(stage, motion, drive, goal)
            except SolveError as error:
                error.context["frame"] = number
                raise
            done.append(_frame(stage, number, pose, goal, stepped))
            motion = beside.motion = stepped.motion
            drive = goal
            chunks.add(done[-1])
            part = (number + 1) / len(times)
            words = f"frame {number + 1} of {len(times)}"
            progress(Step("simulate", part, number + 1, stepped.residual, message=words))
    finally:
        chunks.flush()
    return done


def skin_of(stage: Stage, frame: MotionRecord) -> Floats:
    """Return the whole skin (V, 3) of a frame, in the head's frame."""
    return stage.skin(stage.model.rest + frame.moved, frame.jaw, frame.eyes, frame.time)


def joints_of(carried: CarriedHead, times: Floats, unposed: Singles) -> Joints | None:
    """Return the joints of a neck at ``times`` (f,) s, which carry skins ``unposed`` (f, V, 3)."""
    if carried.skin is None:
        return None
    turns = np.array([carried.pose(time).turns for time in times.tolist()])
    still = np.zeros((len(times), 1, 3))
    return Joints(
        BODIES,
        np.vstack([np.zeros(3), carried.placed.neck.centres]),
        np.concatenate([still, turns], axis=1),
        *two_bones(carried.skin.places),
        unposed,
    )


def finish(
    stage: Stage,
    frames: Sequence[MotionRecord],
    out: Path,
    progress: ProgressCallback,
    *,
    title: str,
    video: bool,
    more: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray] = NO_ARRAYS,
) -> list[Path]:
    """Write what a scene leaves.

    ``more`` figures are for ``animation.json``, and ``arrays`` with a row for each frame for
    ``animation.npz``.
    """
    progress(Step("export", EXPORT))
    model = stage.model
    arrays = dict(arrays)
    if stage.tracks is not None:
        lines = stage.tracks.lines
        arrays["lengths"] = np.array([lines.lengths(model.rest + frame.moved) for frame in frames])
    figures = {"penetration_neutral_mm": round(stage.gauge.neutral().most, 4), **more}
    times = np.array([frame.time for frame in frames])
    if stage.neck is not None:
        arrays |= stage.neck.arrays(times)
        figures["neck"] = stage.neck.report()
        told = [notice.as_dict() for notice in stage.neck.notices]
        figures["notices"] = [*figures.get("notices", []), *told]
    with tempfile.TemporaryFile() as stream, tempfile.TemporaryFile() as at_rest:
        shape = (len(frames), *model.skin.vertices.shape)
        skins = np.memmap(stream, np.float32, "w+", shape=shape)
        for number, frame in enumerate(frames):
            skins[number] = skin_of(stage, frame)
        joints = None
        if stage.neck is not None:
            unposed = np.memmap(at_rest, np.float32, "w+", shape=shape)
            for number, frame in enumerate(frames):
                unposed[number] = stage.neck.unposed(frame.time, skins[number])
            joints = joints_of(stage.neck, times, unposed)
            draw_carried(out / NECK_PICTURE, stage.neck, frames, skins)
        files = write_animation(
            out,
            model,
            frames,
            skins,
            title=title,
            report=motion_report(frames, model) | figures,
            vertices=model.face,
            muscles=stage.muscles,
            arrays=arrays,
            objects=stage.objects,
            joints=joints,
            video=video,
        )
    if stage.neck is not None:
        files.append(out / NECK_PICTURE)
    progress(Step("done", 1.0))
    return files


def draw_carried(
    path: Path, carried: CarriedHead, frames: Sequence[MotionRecord], skins: Singles
) -> None:
    """Draw a neck in the first of ``frames``, and in those in which the head turns most."""
    turned = np.array([frame.head[:3] for frame in frames])
    most = [int(np.abs(column).argmax()) for column in turned.T]
    shots = []
    for number in dict.fromkeys([0, *most]):
        frame = frames[number]
        skin = frame.into_world(skins[number].astype(np.float64))
        pose = carried.pose(frame.time)
        active = carried.activations(frame.time)
        shots.append(NeckShot(f"{frame.time:.2f} s", skin, pose, active))
    places = None if carried.skin is None else carried.skin.places
    draw_neck(path, carried.model, carried.placed.neck, shots, carried.words, places)


def _reach(stage: Stage, motion: FleshMotion, drive: Drive | None, goal: Drive) -> Stepped:
    """Go to ``goal`` from where the frame before ended; the first frame is at rest there."""
    begun = time.perf_counter()
    if drive is None:
        at_rest = stage.simulator.rest(goal)
        spent = time.perf_counter() - begun
        return Stepped(at_rest, at_rest.y, 0, 0, 0.0, spent, stage.count_inverted(at_rest.y))
    iterations = halvings = 0
    moments = np.linspace(drive.time, goal.time, stage.steps_per_frame + 1)[1:-1].tolist()
    between = [stage.drive(moment, stage.drives(moment)) for moment in moments]
    for target in [*between, goal]:
        stepped = stage.simulator.step(motion, drive, target)
        motion = stepped.motion
        drive = target
        iterations += stepped.iterations
        halvings += stepped.halvings
    spent = time.perf_counter() - begun
    return replace(stepped, iterations=iterations, halvings=halvings, seconds=spent)


def _frame(
    stage: Stage, number: int, pose: PosedFrame, goal: Drive, stepped: Stepped
) -> MotionRecord:
    found = stage.penetration(stepped.y, goal)
    return MotionRecord(
        frame=number,
        time=goal.time,
        activations=pose.a,
        jaw=pose.jaw,
        head=goal.head.twist,
        eyes=pose.eyes,
        moved=stepped.y - stage.model.rest,
        penetration_mm=round(found.most, 4),
        behind_teeth=found.behind_teeth,
        inverted=stepped.inverted,
        iterations=stepped.iterations,
        halvings=stepped.halvings,
        residual=stepped.residual,
        seconds=round(stepped.seconds, 4),
    )


class _Beside:
    """Values beside the frames of a file: the motion to go on from, and at times a picture."""

    def __init__(
        self,
        scene: str,
        stage: Stage,
        motion: FleshMotion,
        options: PictureOptions = PictureOptions(),
    ) -> None:
        self._scene = scene
        self._stage = stage
        self._options = options
        self._pictured = -np.inf
        self._filming = Filming(stage.model)
        self.motion = motion

    def __call__(self, last: MotionRecord) -> dict[str, Any]:
        """Return them for a file with this ``last`` frame, which ended in ``motion``."""
        is_due = time.monotonic() - self._pictured >= self._options.seconds
        return motion_values(self._scene, self.motion, self._draw(last) if is_due else None)

    def _draw(self, frame: MotionRecord) -> str:
        skin = frame.into_world(skin_of(self._stage, frame))
        objects = [each.at(frame.time) for each in self._stage.objects]
        light = self._filming.light(skin)
        pixels = self._filming.picture(skin, light, self._options.size, objects=objects)
        content = io.BytesIO()
        image = Image.fromarray((pixels * 255 + 0.5).astype(np.uint8))
        image.save(content, "JPEG", quality=self._options.quality)
        self._pictured = time.monotonic()
        return base64.b64encode(content.getvalue()).decode()
