"""The job that plays a recording: of Live Link Face, of OpenFace, or a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from solver.animation import FrameChanges, RecordedDrives
from solver.animation.blendshapes import Blendshapes, DrivenShapes, driven_motions
from solver.animation.controls import Controls
from solver.animation.controls.exact import ShapesAtRest, fit_frames
from solver.animation.lids import Lids, PlayedLids
from solver.animation.tracks import TrackedShapes
from solver.errors import InputError, make_warning, quote_names
from solver.fitting.drives.stored import are_same
from solver.fitting.target_checks import check_held
from solver.jobs import Task, read_template
from solver.jobs.blendshapes import SOLVED, left_files, person_blendshapes, tell_blendshapes
from solver.jobs.live_off import LiveOff
from solver.jobs.scenes import CARRIED, EXPORT, READ, fingerprint, finish, play, read_player
from solver.kinds.animate import Animate
from solver.mechanics.linear import fastest
from solver.neck.body import import_mujoco
from solver.progress import ProgressCallback, Step, part_of
from solver.rig import Rig
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.recordings import SIGNALS_FILE, read_recording, tell_detection
from solver.scene import Stage
from solver.scene.document import head_of, without_neck_muscles
from solver.scene.places import Places
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackContact

TOLD_ABOVE = 0.1  # change of a weight without a shape that is worth a notice


def run(task: Task[Animate]) -> list[Path]:
    """Play a recording on a fitted face, as :func:`solver.jobs.simulate.run`.

    Learned controls say what the muscles do, where the rig has them, and frames that they doubt are
    fitted exactly before; the scene may ask for another way. Else expressions are blended.
    Activations and jaw of every expression of the template are solved first, once for a rig: the
    ``blendshapes.npz`` that this leaves is taken as it is if it is given, and of muscles within
    the limits of the rig's. They begin with the rig's basis of expressions, which is solved and
    left where no earlier job has. Where the scene says so tracks drive the face, whose shapes are
    the recording's, and nothing is solved before. Raises, besides, ``basis.*``, ``blendshapes.*``,
    ``tracks.*``, ``live_link.*``, ``openface.*`` and ``video.*``. What is measured of a
    video is left as ``signals.csv``.
    """
    given = task.options
    out = task.out
    progress = task.progress
    rig, places = read_player(task)
    recording = given.scene.recording
    signals = out / SIGNALS_FILE
    asset = places.asset(recording.asset)
    live = LiveOff(task, rig, asset, -recording.start)
    if asset.resolve() != signals.resolve():
        signals.unlink(missing_ok=True)  # of another scene
    recorded = read_recording(asset, recording, signals, tell_detection(progress, READ))
    for notice in recorded.notices:
        progress(Step("warning", READ, message=notice.message))

    played = _Played()
    stage, drives, playing = _set_stage(task, rig, places, recorded, played)
    more = {**_told_of(recorded, drives.names, played.transfer, playing), **played.figures}
    if recorded.timecodes:
        more["timecode"] = recorded.timecodes[recording.start]
    frames = play(stage, out, fingerprint(task), playing, resume=task.resume)
    more |= live.report(
        (each.frame, stage.skin_of_flesh(stage.model.rest + each.moved, each.jaw, each.time))
        for each in frames
    )
    shown = recorded.seen[recording.start : recording.end]
    arrays = {"weights": drives.weights, "seen": shown, **played.arrays}
    written = finish(
        stage, frames, out, progress, title="Animation", video=given.video, more=more, arrays=arrays
    )
    left = [signals] if signals.is_file() else []
    return [*written, *played.files, *left]


def _set_stage(
    task: Task[Animate], rig: Rig, places: Places, recorded: FaceTake, played: _Played
) -> tuple[Stage, RecordedDrives, ProgressCallback]:
    """Return the stage, what drives it, and the progress of its playing."""
    given = task.options
    scene = given.scene
    recording = scene.recording
    model = rig.model
    S = rig.weights

    def stage_of(
        drives: RecordedDrives,
        begun: float,
        firmer: float = 1.0,
        tracks: MuscleTracks | None = None,
    ) -> tuple[Stage, RecordedDrives, ProgressCallback]:
        playing = part_of(task.progress, begun, EXPORT)
        stage = Stage(
            scene,
            places,
            S,
            drives,
            given.linear_solver,
            firmer=firmer,
            tracks=tracks,
            lids=_lids_of(task, rig, drives),
            progress=part_of(playing, 0.0, CARRIED),
        )
        return stage, drives, playing

    def check(drives: RecordedDrives) -> None:
        if scene.neck is not None and scene.neck.muscles:
            import_mujoco()
        Stage(without_neck_muscles(scene), places, S, drives, given.linear_solver)

    def drives_of(shapes: DrivenShapes, changes: FrameChanges | None = None) -> RecordedDrives:
        return RecordedDrives(
            recorded,
            shapes,
            model,
            recording.start,
            recording.end,
            head=head_of(scene.head),
            limits=rig.limits,
            changes=changes,
        )

    if scene.drive == "tracks":
        if scene.controls is not None:
            reason = "controls are of muscles, and tracks drive the face: leave one of both out"
            raise InputError("scene.controls", reason)
        tracks = MuscleTracks.load(task.inputs["tracks"], model)
        drives = drives_of(TrackedShapes.of(model, tracks))
        played.figures["shapes"] = len(tracks.names)
        played.transfer["controls"] = "tracks"
        return stage_of(drives, READ, TrackContact.firmer, tracks)
    # what moves the muscles may take minutes: what is wrong with the scene is told before
    check(drives_of(Blendshapes(model.muscle_names, {})))
    shapes = _shapes_of(task, rig, played)
    weights = drives_of(shapes).weights
    drives = drives_of(shapes, _fit_frames(task, rig, shapes, weights, played))
    return stage_of(drives, SOLVED)


def _lids_of(task: Task[Animate], rig: Rig, drives: RecordedDrives) -> PlayedLids | None:
    """Return what leads the lids, if the scene asks for it and the template's shapes fit."""
    lids = Lids.of(rig.model)
    if not (lids and task.options.scene.lids):
        return None
    basis = read_template(task).shapes
    if basis is not None and basis.expressions.shape[1] == len(rig.model.skin.vertices):
        return PlayedLids(lids, basis, drives)
    message = "lids stay where muscles leave them: the template has no shapes of this skin"
    task.progress(Step("warning", READ, message=message))
    return None


def _told_of(
    take: FaceTake, driven: Sequence[str], played: Mapping[str, Any], progress: ProgressCallback
) -> dict[str, Any]:
    """Return the figures of a whole recording, and of how it was ``played`` by ``driven`` shapes.

    Tell ``progress`` of shapes that move in it and drive none.
    """
    whole = float(take.times[-1])
    motion = np.ptp(take.weights, axis=0)
    sources = {arkit_source(name) for name in driven}
    unseen = [name for name, by in zip(ARKIT_NAMES, motion, strict=True) if by == 0.0]
    lacking = [name for name in ARKIT_NAMES if name not in sources and name not in unseen]
    transfer = {
        "format": take.source,
        "fps": round((len(take.times) - 1) / whole, 3) if whole else None,
        "seen": int(take.seen.sum()),
        "gaps": len(take.gaps),
        "longest_gap_s": round(max(take.gaps, default=0.0), 3),
        "unseen_shapes": [name for name in ARKIT_NAMES if name in {*unseen, *lacking}],
        **played,
    }
    notices = list(take.notices)
    if any(motion[ARKIT_NAMES.index(name)] > TOLD_ABOVE for name in lacking):
        reason = f"nothing of the face is driven by {', '.join(quote_names(lacking))}"
        message = f"{reason}, which move in the recording: the template has no such shapes"
        notices.append(make_warning("recording.shapes", message, {"found": lacking}))
        progress(Step("warning", 0.0, message=message))
    return {"transfer": transfer, "notices": [notice.as_dict() for notice in notices]}


@dataclass
class _Played:
    """Figures and arrays about the played frames, for the report and the sequence."""

    files: list[Path] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    transfer: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def _shapes_of(task: Task[Animate], rig: Rig, played: _Played) -> DrivenShapes:
    """Return what a frame's weights make the muscles do, as the scene asks for it."""
    asked = task.options.scene.controls
    model = rig.model
    if asked == "exact":
        played.transfer["controls"] = "exact"
        motions = driven_motions(model, read_template(task).shapes)
        return ShapesAtRest(tuple(motions), model.muscle_count)
    if asked == "learned" and "controls" not in task.inputs:
        reason = "the rig has no learned controls: run learn_controls first, or leave controls out"
        raise InputError("controls.missing", reason)
    if asked != "blended" and "controls" in task.inputs:
        learned = Controls.load(task.inputs["controls"], model, rig.weights)
        if are_same(learned.drive, rig.drive):
            played.transfer["controls"] = "learned"
            return learned
        reason = "its muscles were kept to other limits than the rig's: learn its controls again"
        if asked == "learned":
            raise InputError("controls.model", reason)
        task.progress(Step("warning", READ, message=f"controls.npz is not used: {reason}"))
    blended = person_blendshapes(task, rig)
    played.transfer["controls"] = "blended"
    played.files += left_files(task)
    played.figures |= tell_blendshapes(blended)
    return blended


def _fit_frames(
    task: Task[Animate], rig: Rig, shapes: DrivenShapes, weights: Floats, played: _Played
) -> FrameChanges | None:
    """Fit the frames that learned controls doubt, or all where the scene says exact."""
    if isinstance(shapes, Blendshapes):
        return None
    chosen = np.ones(len(weights), bool)
    if isinstance(shapes, Controls):
        doubt = shapes.doubt_mm(weights)
        chosen = doubt > task.options.scene.exact_above_mm
        played.arrays["doubt_mm"] = doubt.astype(np.float32)
    played.transfer["flagged"] = int(chosen.sum())
    played.arrays["exact"] = chosen
    if not chosen.any():
        played.transfer["exact"] = 0
        return None
    face = rig.face(fastest())
    count = int(chosen.sum())
    check_held(face)

    def listen(done: int) -> None:
        part = READ + (SOLVED - READ) * done / count
        words = f"frame {done} of {count}"
        task.progress(Step("exact", part, done, message=words))

    motions = driven_motions(rig.model, read_template(task).shapes)
    changes, fitted = fit_frames(face, shapes, motions, weights, chosen, rig.limits, listen)
    played.transfer["exact"] = int(fitted.sum())
    played.arrays["exact"] = fitted
    return changes
