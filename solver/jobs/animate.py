"""The job that plays a recording of Live Link Face or OpenFace."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import ShapeBasis
from solver.animation import RecordedDrives
from solver.animation.blendshapes import (
    Blendshapes,
    DrivenShapes,
    Solved,
    expression_targets,
    solve_blendshapes,
)
from solver.animation.tracks import TrackedShapes
from solver.errors import InputError
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.fitting.face import Face
from solver.fitting.target_checks import check_held
from solver.jobs import Task, read_template
from solver.jobs.fits import solve_basis
from solver.jobs.scenes import EXPORT, READ, fingerprint, finish, play, read_person
from solver.kinds.animate import Animate
from solver.kinds.scene import Recording
from solver.mechanics.linear import fastest
from solver.progress import Step, part_of
from solver.rig import Rig
from solver.rig.frames.animation import check_video
from solver.scans.openface import is_openface, read_openface
from solver.scans.performance import ARKIT_NAMES, FaceTake, read_live_link
from solver.scene import Stage
from solver.scene.document import head_of
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackContact

BASIS = 0.1  # part of a job after which its basis is solved, if none was left
SOLVED = 0.3  # part of a job after which its blendshapes are solved
SAVED_EVERY = 5  # blendshapes that are solved between two writings of their file


def run(task: Task[Animate]) -> list[Path]:
    """Play a recording on a fitted face, as :func:`solver.jobs.simulate.run`.

    Activations and jaw of every expression of the template are solved first, once for a rig: the
    ``blendshapes.npz`` that this leaves is taken as it is if it is given, and of muscles within
    the limits of the rig's. They begin with the rig's basis of expressions, which is solved and
    left where no earlier job has. Where the scene says so tracks drive the face, whose shapes are
    the recording's, and nothing is solved before. Raises, besides, ``basis.*``, ``blendshapes.*``,
    ``tracks.*``, ``live_link.*`` and ``openface.*``.
    """
    given, out, progress = task.options, task.out, task.progress
    if given.video:
        check_video()
    scene = given.scene
    rig, places = read_person(task)
    model, S = rig.model, rig.weights
    recording = scene.recording
    recorded = read_recording(places.asset(recording.asset), recording)
    for notice in recorded.notices:
        progress(Step("warning", READ, message=notice.message))

    def stage_of(shapes: DrivenShapes, tracks: MuscleTracks | None = None) -> Stage:
        head = head_of(scene.head)
        start, end = recording.start, recording.end
        of_take = recorded, shapes, model, start, end
        drives = RecordedDrives(*of_take, head=head, limits=rig.limits)
        firmer = 1.0 if tracks is None else TrackContact.firmer
        return Stage(scene, places, S, drives, given.linear_solver, firmer=firmer, tracks=tracks)

    kept = out / "blendshapes.npz"
    if scene.drive == "tracks":
        tracks = MuscleTracks.load(task.inputs["tracks"], model)
        stage, begun = stage_of(TrackedShapes.of(model, tracks), tracks), READ
        told: dict[str, Any] = {"shapes": len(tracks.names)}
    else:
        shapes = None
        if "blendshapes" in task.inputs:
            shapes = Blendshapes.load(task.inputs["blendshapes"], model, S)
        if shapes is None or shapes.drive != rig.drive:  # solved by a release without limits
            # the shapes take minutes: what is wrong with the scene is told before
            stage_of(Blendshapes(model.muscle_names, {}))
            shapes = _solve_shapes(rig, kept, task)
        shapes.save(kept, model, S)
        stage, begun = stage_of(shapes), SOLVED
        told = _told(shapes)
    more = {**_told_of(recorded), **told}
    if recorded.timecodes:
        more["timecode"] = recorded.timecodes[recording.start]
    playing = part_of(progress, begun, EXPORT)
    frames = play(stage, out, fingerprint(task), playing, resume=task.resume)
    written = finish(stage, frames, out, progress, title="Animation", video=given.video, more=more)
    solved = [] if stage.tracks else [kept, out / BASIS_FILE]
    return [*written, *(file for file in solved if file.is_file())]


def read_recording(path: Path, entry: Recording) -> FaceTake:
    """Return a recording of Live Link Face or OpenFace, which its content tells apart.

    Raises as their readers, and ``live_link.options`` for what is OpenFace's alone.
    """
    if is_openface(path):
        return read_openface(path, entry)
    plain = Recording(asset=entry.asset, start=entry.start, end=entry.end)
    other = [name for name, value in plain if getattr(entry, name) != value]
    if other:
        reason = f"{other[0]} is an option of recordings of OpenFace, and this is of Live Link Face"
        message = f"{path.name}: {reason}"
        raise InputError("live_link.options", message, file=path.name, found=other)
    return read_live_link(path)


def _told_of(take: FaceTake) -> dict[str, Any]:
    """Return the figures of a whole recording."""
    whole = float(take.times[-1])
    is_still = np.ptp(take.weights, axis=0) == 0.0
    transfer = {
        "format": take.source,
        "fps": round((len(take.times) - 1) / whole, 3) if whole else None,
        "seen": int(take.seen.sum()),
        "gaps": len(take.gaps),
        "longest_gap_s": round(max(take.gaps, default=0.0), 3),
        "unseen_shapes": [name for name, still in zip(ARKIT_NAMES, is_still, strict=True) if still],
    }
    return {"transfer": transfer, "notices": [notice.as_dict() for notice in take.notices]}


def _told(shapes: Blendshapes) -> dict[str, Any]:
    """Return the figures of solved blendshapes."""
    solved = shapes.shapes
    return {
        "blendshapes": len(solved),
        "blendshapes_mean_mm": float(np.mean([shape.mean_mm for shape in solved.values()])),
        "not_settled": [name for name, shape in solved.items() if not shape.settled],
    }


def _solve_shapes(rig: Rig, kept: Path, task: Task[Animate]) -> Blendshapes:
    """Solve the person's blendshapes, those left of a resumed job; the file is ``kept`` up."""
    model, S = rig.model, rig.weights
    anatomy = read_template(task)
    targets = expression_targets(model, anatomy.shapes)
    done: dict[str, Solved] = {}
    if task.resume and kept.is_file():
        known = Blendshapes.load(kept, model, S)
        done.update(known.shapes if known.drive == rig.drive else {})

    def report(name: str, solved: Solved) -> None:
        done[name] = solved
        if len(done) % SAVED_EVERY == 0:
            Blendshapes(model.muscle_names, done, rig.drive).save(kept, model, S)
        count, error = len(done), solved.mean_mm
        fraction = BASIS + (SOLVED - BASIS) * count / len(targets)
        words = f"{name}, {count} of {len(targets)}"
        task.progress(Step("blendshapes", fraction, count, mean_error_mm=error, message=words))

    face = rig.face(fastest())
    check_held(face)
    begin = _known_changes(task, face, anatomy.shapes) if targets.keys() - done.keys() else {}
    return solve_blendshapes(face, targets, dict(done), report, begin)


def _known_changes(task: Task[Animate], face: Face, shapes: ShapeBasis | None) -> dict[str, Floats]:
    """Return name -> the change of the controls that makes an expression about."""
    assert shapes is not None, "there are targets, so the template has shapes"

    def show(done: float) -> None:
        task.progress(Step("expressions", READ + (BASIS - READ) * done))

    basis = solve_basis(task, face, shapes.expressions, show)
    return dict(zip(shapes.expression_names, basis.whole, strict=True))
