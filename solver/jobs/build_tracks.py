"""The job that builds muscle tracks of a subject's model."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import CORRECTED
from solver.anatomy.tetrahedra import volumes
from solver.errors import SolveError
from solver.jobs import Task, read_template
from solver.kinds.build_tracks import BuildTracks
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.progress import ProgressCallback, Step
from solver.rig.pictures import TrackShot, tracks_picture
from solver.storage import write_json
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackOptions, TrackTargets
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.shapes import template_shapes


@dataclass(frozen=True)
class ShownOptions:
    """Shapes that are tried on the flesh and drawn: those that move the face most."""

    count: int = 4


def run(task: Task[BuildTracks]) -> list[Path]:
    """Carry a template's expressions into a model's flesh, and try those that move it most.

    Raises :class:`~solver.errors.InputError`: ``tracks.*``, and as the files' readers.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["model"].name))
    model = SubjectModel.load(task.inputs["model"])
    shapes = template_shapes(model, read_template(task).shapes)
    progress(Step("tracks", 0.1))
    options = TrackOptions(given.bones, given.length_mm, given.stiffness, given.law)
    begun = time.perf_counter()
    tracks = MuscleTracks.of(model, shapes, options)
    seconds = time.perf_counter() - begun
    files = [task.out / name for name in ("tracks.npz", "tracks.json", "tracks.png")]
    tracks.save(files[0])
    shots = _try(model, tracks, shapes, progress)
    write_json(files[1], {**_figures(model, tracks, shots), "precompute_s": round(seconds, 2)})
    progress(Step("pictures", 0.95))
    tracks_picture(model, shots, files[2])
    progress(Step("done", 1.0))
    return files


def _try(
    model: SubjectModel,
    tracks: MuscleTracks,
    shapes: Mapping[str, Floats],
    progress: ProgressCallback,
    options: ShownOptions = ShownOptions(),
) -> list[TrackShot]:
    """Go from rest to each of the shapes that move the face most, one of a pair."""
    moved = {
        name: float(np.linalg.norm(motion[model.face], axis=1).mean())
        for name, motion in shapes.items()
        if name not in CORRECTED
    }
    chosen: dict[str, str] = {}
    for name in sorted(moved, key=lambda each: -moved[each]):
        chosen.setdefault(name.removesuffix("Left").removesuffix("Right"), name)
    names = list(chosen.values())[: options.count]
    face = TrackFace(model, tracks, track_potentials(model), linear=fastest())
    rest = face.rest()
    shots = []
    for number, name in enumerate(names):
        progress(Step("try", 0.2 + 0.7 * number / len(names), number, message=name))
        target = model.skin.vertices + shapes[name]
        try:
            state = face.move(rest, tracks.controls({name: 1.0}))
        except SolveError as error:
            progress(Step("warning", 0.2, message=f"{name} alone comes to no rest: {error}"))
            shots.append(TrackShot(name, target, None, 0))
            continue
        shots.append(TrackShot(name, target, face.skin(state), state.inverted))
    return shots


def _figures(model: SubjectModel, tracks: MuscleTracks, shots: list[TrackShot]) -> dict[str, Any]:
    targets = TrackTargets(model, tracks)
    shapes = []
    for number, name in enumerate(tracks.names):
        pose = targets.at(tracks.controls({name: 1.0}))
        shapes.append(
            {
                "name": name,
                "jaw": tracks.jaw[number].round(5).tolist(),
                "teeth_mm": round(float(tracks.teeth_mm[number]), 4),
                "off_mm": round(float(tracks.off_mm[number]), 4),
                "turned_tets": _count_inverted(model, pose.target),
            }
        )
    lengths = tracks.lines.lengths(model.rest)
    points = np.diff(tracks.lines.first)
    muscles = [
        {
            "name": name,
            "length_mm": round(float(lengths[number]), 2),
            "points": int(points[number]),
            "closed": bool(tracks.lines.closed[number]),
            "stiffness": float(tracks.stiffness[number]),
        }
        for number, name in enumerate(model.muscle_names)
    ]
    return {
        "bones": tracks.bones,
        "length_mm": tracks.length_mm,
        "law": tracks.law,
        "shapes": shapes,
        "muscles": muscles,
        "tried": [shot.figures(model.face) for shot in shots],
        "notices": list(tracks.notices),
    }


def _count_inverted(model: SubjectModel, x: Floats) -> int:
    """Return how many tets are inside out at x (p, 3): there flesh does not follow its target."""
    return int((volumes(x, model.tets) <= 0.0).sum())
