"""The jobs that play a scene: on keys of expressions, muscles and jaw, or on a recording."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from PIL import Image
from scipy.spatial.transform import Rotation

from solver.anatomy.template import Template
from solver.animation.blendshapes import (
    Blendshapes,
    Solved,
    expression_targets,
    solve_blendshapes,
)
from solver.animation.keys import PosedFrame
from solver.animation.recording import from_recording
from solver.errors import SolveError
from solver.fitting.face import Face, Pose
from solver.fitting.target_checks import check_held
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.pipeline.common import Options, activations_file, take
from solver.progress import Progress, Step, silent
from solver.rig.animation import check_video, write_animation
from solver.rig.animation_picture import Filming
from solver.rig.frames import FRAMES, ChunkOptions, ChunkWriter
from solver.rig.motion import MotionFrame, motion_report, motion_values, read_motion
from solver.rig.result import ExpressionFit, load_activations, load_weights
from solver.scans.live_link import read_live_link
from solver.scene.document import check
from solver.scene.keys import head_of, keyed
from solver.scene.places import Places
from solver.scene.stage import Stage
from solver.similarity import Similarity
from solver.simulation.inertia import (
    Drive,
    Motion,
)
from solver.simulation.simulator import Stepped
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template

# Whom a scene is about: the files of a fitted person, and what is in them.


@dataclass(frozen=True)
class Person:
    """A fitted face with its S (n, m + 1), and the places on it."""

    model: SubjectModel
    S: sp.csr_array
    places: Places


@dataclass(frozen=True)
class PersonFiles:
    """The files that every job with a scene reads.

    model, weights
        ``model.npz``, and the rig's ``muscle_weights.npz``.
    rig
        The rig's ``activations.npz``, or its folder: the expressions.
    assets
        Name -> file, what the scene names.
    template
        The template that the model was made with, None for the built-in one: the scene may name
        its landmarks.
    """

    model: Path
    weights: Path
    rig: Path
    assets: Mapping[str, Path] = field(default_factory=dict)
    template: Path | None = None

    def read(self, progress: Progress) -> Person:
        """Return the person; raises as its files' readers, and ``scene.template``."""
        progress(Step("read", 0.0, message=self.model.name))
        model = SubjectModel.load(self.model)
        S = load_weights(self.weights, model)
        return Person(model, S, Places.of(model, self.template, self.assets))

    def expressions(self, model: SubjectModel) -> tuple[ExpressionFit, ...]:
        """Return the rig's expressions; raises as :func:`load_activations`."""
        return load_activations(activations_file(self.rig), model)

    def fingerprint(self, document: Mapping[str, Any], **more: Path | None) -> str:
        """Return the hash of a scene and of all files, ``more`` too, that it is played with."""
        files = {
            "model": self.model,
            "weights": self.weights,
            "rig": activations_file(self.rig),
            "template": self.template,
            **more,
            **{f"asset {name}": path for name, path in self.assets.items()},
        }
        hashes = {name: _hash(path) for name, path in files.items() if path is not None}
        return hashlib.sha256(json.dumps([document, hashes], sort_keys=True).encode()).hexdigest()


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# A scene's frames, one after the other: what simulations and animations share.


CHUNKS = ChunkOptions(frames=10)
EXPORT = 0.9
"""Part of a job after which its files are written."""
PICTURE_SIZE, PICTURE_QUALITY = (240, 300), 85
PICTURE_SECONDS = 10.0
"""A file of frames has a picture if none had for so long."""


def play(
    stage: Stage,
    out: Path,
    scene: str,
    progress: Progress,
    *,
    resume: bool,
    share: tuple[float, float],
) -> list[MotionFrame]:
    """Simulate all frames of a stage and return them; they are in ``out/frames`` as they come.

    With ``resume`` the frames that are there are kept, and the simulation goes on after them.
    ``scene`` is the hash of what is simulated, ``share`` where in the whole job's progress this
    begins and ends. Raises :class:`~solver.errors.SolveError` (``simulate.*``)
    with the ``frame`` that could not be reached; those before it stay.
    """
    if not resume:
        shutil.rmtree(out / FRAMES, ignore_errors=True)
    ready = read_motion(out / FRAMES, scene, stage.model.rest)
    done, motion = ready.frames, ready.motion
    times = stage.drives.times
    beside = _Beside(scene, stage, motion)
    chunks = ChunkWriter(out / FRAMES, len(done), CHUNKS, beside)
    drive: Drive | None = None
    if done:
        before = float(times[len(done) - 1])
        drive = stage.drive(before, stage.drives(before))
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
            frame = _frame(stage, number, pose, goal, stepped)
            motion = beside.motion = stepped.motion
            drive = goal
            chunks.add(frame)
            done.append(frame)
            part = (number + 1) / len(times)
            words = f"frame {number + 1} of {len(times)}"
            fraction = share[0] + part * (share[1] - share[0])
            progress(Step("simulate", fraction, number + 1, stepped.residual, message=words))
    finally:
        chunks.flush()
    return done


def skin_of(stage: Stage, frame: MotionFrame) -> Floats:
    """Return the whole skin (V, 3) of a frame, in the head's frame."""
    return stage.skin(stage.model.rest + frame.moved, frame.jaw, frame.eyes)


def finish(
    stage: Stage,
    frames: Sequence[MotionFrame],
    out: Path,
    progress: Progress,
    *,
    title: str,
    video: bool,
    more: Mapping[str, Any],
) -> list[Path]:
    """Write what a scene leaves; ``more`` figures are for ``animation.json``."""
    progress(Step("export", EXPORT))
    model = stage.model
    neutral_mm = round(stage.gauge.neutral().most, 4)
    with tempfile.TemporaryFile() as stream:
        shape = (len(frames), *model.skin.vertices.shape)
        skins = np.memmap(stream, np.float32, "w+", shape=shape)
        for number, frame in enumerate(frames):
            skins[number] = skin_of(stage, frame)
        files = write_animation(
            out,
            model,
            frames,
            skins,
            title=title,
            report={**motion_report(frames, model), "penetration_neutral_mm": neutral_mm, **more},
            vertices=model.face,
            objects=stage.objects,
            video=video,
        )
    progress(Step("done", 1.0))
    return files


def _reach(stage: Stage, motion: Motion, drive: Drive | None, goal: Drive) -> Stepped:
    """Go to ``goal`` from where the frame before ended; the first frame is at rest there."""
    begun = time.perf_counter()
    if drive is None:
        at_rest = stage.simulator.rest(goal)
        spent = time.perf_counter() - begun
        return Stepped(at_rest, at_rest.y, 0, 0, 0.0, spent, stage.inverted(at_rest.y))
    iterations = halvings = 0
    for target in _between(stage, drive, goal):
        stepped = stage.simulator.step(motion, drive, target)
        motion, drive = stepped.motion, target
        iterations += stepped.iterations
        halvings += stepped.halvings
    spent = time.perf_counter() - begun
    return replace(stepped, iterations=iterations, halvings=halvings, seconds=spent)


def _between(stage: Stage, drive: Drive, goal: Drive) -> Iterator[Drive]:
    """Return what the flesh is asked for in the steps of one frame, ``goal`` at last."""
    for moment in np.linspace(drive.time, goal.time, stage.steps_per_frame + 1)[1:-1]:
        yield stage.drive(float(moment), stage.drives(float(moment)))
    yield goal


def _frame(
    stage: Stage, number: int, pose: PosedFrame, goal: Drive, stepped: Stepped
) -> MotionFrame:
    found = stage.penetration(stepped.y, goal)
    return MotionFrame(
        frame=number,
        time=goal.time,
        activations=pose.a,
        jaw=pose.jaw,
        head=_place(goal.head),
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


def _place(head: Similarity) -> Floats:
    """Return rotation vector and shift (6,) of a motion."""
    turn = Rotation.from_matrix(head.rotation).as_rotvec()
    return np.concatenate([turn, head.shift])


class _Beside:
    """Values beside the frames of a file: the motion to go on from, and at times a picture."""

    def __init__(self, scene: str, stage: Stage, motion: Motion) -> None:
        self._scene, self._stage = scene, stage
        self._pictured = -np.inf
        self._filming = Filming(stage.model)
        self.motion = motion

    def __call__(self, last: MotionFrame) -> dict[str, Any]:
        """Return them for a file with this ``last`` frame, which ended in ``motion``."""
        picture = self._draw(last)
        encoded = None if picture is None else base64.b64encode(picture).decode()
        return motion_values(self._scene, self.motion, encoded)

    def _draw(self, frame: MotionFrame) -> bytes | None:
        """Return a JPEG of a frame, if there has been none for a while."""
        if time.monotonic() - self._pictured < PICTURE_SECONDS:
            return None
        skin = frame.placed(skin_of(self._stage, frame))
        objects = [each.at(frame.time) for each in self._stage.objects]
        light = self._filming.light(skin)
        pixels = self._filming.picture(skin, light, PICTURE_SIZE, objects=objects)
        content = io.BytesIO()
        image = Image.fromarray((pixels * 255 + 0.5).astype(np.uint8))
        image.save(content, "JPEG", quality=PICTURE_QUALITY)
        self._pictured = time.monotonic()
        return content.getvalue()


DEFAULTS: dict[str, Any] = {"scene": {}, "video": False, "linear_solver": None}
READ = 0.02
SOLVED = 0.3
"""Parts of a job after which its files are read, and its blendshapes solved."""
SAVED_EVERY = 5
"""Blendshapes that are solved between two writings of their file."""


def simulate(
    person: PersonFiles,
    out: Path,
    *,
    resume: bool = False,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Play keys of a rig's expressions, of muscles and of the jaw on a fitted face.

    Frames that are ready are in ``out/frames``; with ``resume`` those that are there are kept and
    the simulation goes on after them. Options: ``scene`` as in docs/guide/simulation.md, ``video``
    (an MP4, too), and ``linear_solver``.

    Writes ``animation.glb``, ``animation.npz``, ``animation.png`` and ``animation.json``. Raises
    :class:`InputError` (``scene.*``) for a scene that does not fit the person,
    :class:`~solver.errors.SolveError` (``simulate.*``) where the flesh finds no way on; the frames
    before stay in ``out/frames``.
    """
    given = _options(options)
    scene = check(given["scene"], "simulate")
    out.mkdir(parents=True, exist_ok=True)
    known = person.read(progress)
    poses = {fit.name: Pose(fit.activations, fit.jaw) for fit in person.expressions(known.model)}
    drives = keyed(scene, poses, known.model, known.S)
    stage = Stage(scene, known.places, known.S, drives, given["linear_solver"])
    whole, share = person.fingerprint(scene), (READ, EXPORT)
    frames = play(stage, out, whole, progress, resume=resume, share=share)
    return finish(stage, frames, out, progress, title="Simulation", video=given["video"], more={})


def animate(
    person: PersonFiles,
    out: Path,
    *,
    blendshapes: Path | None = None,
    resume: bool = False,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Play a recording of Live Link Face on a fitted face.

    Activations and jaw of every expression of the template are solved first, once for a rig: the
    ``blendshapes.npz`` that this leaves is taken as it is if it is given. All else is as in
    :func:`simulate`. Raises, besides, ``blendshapes.*`` and ``live_link.*``.
    """
    given = _options(options)
    scene = check(given["scene"], "animate")
    out.mkdir(parents=True, exist_ok=True)
    known = person.read(progress)
    recording = scene["recording"]
    recorded = read_live_link(known.places.asset(recording["asset"]))

    def staged(shapes: Blendshapes) -> Stage:
        start, end = recording.get("start", 0), recording.get("end")
        head = head_of(scene.get("head", []))
        drives = from_recording(recorded, shapes, known.model, start, end, head=head)
        return Stage(scene, known.places, known.S, drives, given["linear_solver"])

    kept = out / "blendshapes.npz"
    if blendshapes is None:
        # the shapes take minutes: what is wrong with the scene is told before
        staged(Blendshapes(known.model.muscle_names, {}))
        shapes = _solved(known, person.template, kept, progress, resume=resume)
    else:
        shapes = Blendshapes.load(blendshapes, known.model, known.S)
    shapes.save(kept, known.model, known.S)
    stage = staged(shapes)
    whole, share = person.fingerprint(scene, blendshapes=blendshapes), (SOLVED, EXPORT)
    frames = play(stage, out, whole, progress, resume=resume, share=share)
    solved = shapes.shapes
    more = {
        "blendshapes": len(solved),
        "blendshapes_mean_mm": float(np.mean([shape.mean_mm for shape in solved.values()])),
        "not_settled": [name for name, shape in solved.items() if not shape.settled],
    }
    written = finish(
        stage, frames, out, progress, title="Animation", video=given["video"], more=more
    )
    return [*written, kept]


def _options(options: Options) -> dict[str, Any]:
    """Return the options with their defaults; raises ``options.video`` where there is no codec."""
    given = take(options, DEFAULTS)
    if given["video"]:
        check_video()
    return given


def _solved(
    person: Person, template: Path | None, kept: Path, progress: Progress, *, resume: bool
) -> Blendshapes:
    """Solve the person's blendshapes; they are ``kept`` in a file as they come.

    With ``resume`` those in the file are taken as they are.
    """
    model = person.model
    anatomy = builtin_template() if template is None else Template.load(template)
    targets = expression_targets(model, anatomy.shapes)
    done: dict[str, Solved] = {}
    if resume and kept.is_file():
        done.update(Blendshapes.load(kept, model, person.S).shapes)

    def told(name: str, solved: Solved) -> None:
        done[name] = solved
        if len(done) % SAVED_EVERY == 0:
            Blendshapes(model.muscle_names, done).save(kept, model, person.S)
        fraction = READ + (SOLVED - READ) * len(done) / len(targets)
        words = f"{name}, {len(done)} of {len(targets)}"
        error = solved.mean_mm
        progress(Step("blendshapes", fraction, len(done), mean_error_mm=error, message=words))

    face = Face(model, person.S, linear=fastest())
    check_held(face)
    return solve_blendshapes(face, targets, dict(done), told)
