"""The job that builds muscle tracks of a subject's model."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import CORRECTED
from solver.anatomy.tetrahedra import volumes
from solver.errors import Finding, SolveError, count_words, make_warning, quote_names
from solver.fitting.target_checks import before_fit, idle_muscles
from solver.jobs import Task, fits, read_template
from solver.kinds.build_tracks import BuildTracks
from solver.mechanics.linear import fastest
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.progress import ProgressCallback, Step
from solver.rig.pictures import TrackShot, tracks_picture
from solver.storage import write_json
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackOptions
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.own_shapes import PREFIX, OwnShapes, with_own_shapes
from solver.tracks.shapes import template_shapes

# part of all tets; jaw, folds and lips of a template's shapes turn half of it
TURNED = 0.01


@dataclass(frozen=True)
class ShownOptions:
    """Shapes that are tried on the flesh and drawn."""

    count: int = 4  # of the template's: those that move the face most
    own: int = 4  # scans, at most


def run(task: Task[BuildTracks]) -> list[Path]:
    """Carry expressions into a model's flesh, and try those that move it most.

    They are the template's, and what these leave of the person's own scans, if there are any.
    Raises :class:`~solver.errors.InputError`: ``tracks.*``, ``scan.*``, and as the files' readers.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["model"].name))
    model = SubjectModel.load(task.inputs["model"])
    shapes = template_shapes(model, read_template(task).shapes)
    scans = fits.read_scans(model, task.captures) if task.captures else {}
    odd = before_fit(model, scans)
    log = fits.WarningLog(model, progress)
    log.warn(0.05, odd)
    progress(Step("tracks", 0.1))
    options = TrackOptions(given.bones, given.length_mm, given.stiffness, given.law)
    begun = time.perf_counter()
    tracks = MuscleTracks.of(model, shapes, options)
    seconds = time.perf_counter() - begun
    own = with_own_shapes(model, tracks, scans) if scans else OwnShapes(tracks, {})
    files = [task.out / name for name in ("tracks.npz", "tracks.json", "tracks.png")]
    own.tracks.save(files[0])
    face = TrackFace(model, own.tracks, track_potentials(model), linear=fastest())
    shots = _try(face, _shown(model, shapes, scans), progress)
    figures = _figures(face, own, shots)
    found = [*_passive_muscles(face), *_turned_shapes(figures["shapes"], len(model.tets))]
    log.warn(0.9, found)
    known = [make_warning("tracks.shapes", words) for words in tracks.notices]
    notices = [each.as_dict() for each in (*known, *odd, *found)]
    write_json(files[1], {**figures, "notices": notices, "precompute_s": round(seconds, 2)})
    progress(Step("pictures", 0.95))
    tracks_picture(model, shots, files[2])
    progress(Step("done", 1.0))
    return files


def _shown(
    model: SubjectModel,
    shapes: Mapping[str, Floats],
    scans: Mapping[str, RegisteredScan],
    options: ShownOptions = ShownOptions(),
) -> dict[str, Floats]:
    """Return the skins (V, 3) of what is tried, by the shape's name: one of a pair, and scans."""
    moved = {
        name: float(np.linalg.norm(motion[model.face], axis=1).mean())
        for name, motion in shapes.items()
        if name not in CORRECTED
    }
    chosen: dict[str, str] = {}
    for name in sorted(moved, key=lambda each: -moved[each]):
        chosen.setdefault(name.removesuffix("Left").removesuffix("Right"), name)
    names = list(chosen.values())[: options.count]
    own = islice(scans.items(), options.own)
    return {name: model.skin.vertices + shapes[name] for name in names} | {
        PREFIX + name: scan.vertices for name, scan in own
    }


def _try(
    face: TrackFace, shown: Mapping[str, Floats], progress: ProgressCallback
) -> list[TrackShot]:
    """Go from rest to each of the skins that are ``shown``."""
    rest = face.rest()
    shots = []
    for number, (name, target) in enumerate(shown.items()):
        progress(Step("try", 0.2 + 0.7 * number / len(shown), number, message=name))
        try:
            state = face.move(rest, face.tracks.whole(name))
        except SolveError as error:
            progress(Step("warning", 0.2, message=f"{name} alone comes to no rest: {error}"))
            shots.append(TrackShot(name, target, None, 0))
            continue
        shots.append(TrackShot(name, target, face.skin(state), state.inverted))
    return shots


def _passive_muscles(face: TrackFace) -> Iterator[Finding]:
    """Yield the notice ``tracks.passive`` about muscles that no shape makes contract."""
    no_flesh = {each.context["muscle"] for each in idle_muscles(face.face)}
    lacks = {}
    for number, name in enumerate(face.model.muscle_names):
        if name in no_flesh:
            lacks[name] = "flesh"
        elif not face.targets.driven[number]:
            lacks[name] = "line" if face.targets.has_fibres[number] else "fibres"
    if lacks:
        named = quote_names([f"{name} (no {lack})" for name, lack in lacks.items()])
        words = count_words(len(lacks), "muscle stays", "muscles stay")
        message = f"{words} passive in every shape: {', '.join(named)}"
        yield make_warning("tracks.passive", message, {"muscles": lacks})


def _turned_shapes(shapes: Sequence[Mapping[str, Any]], tets: int) -> Iterator[Finding]:
    """Yield the notice ``tracks.turned`` about shapes whose morph turns many tets inside out."""
    many = TURNED * tets
    turned = {each["name"]: each["turned_tets"] for each in shapes if each["turned_tets"] > many}
    if turned:
        named = quote_names([f"{name} ({count})" for name, count in turned.items()])
        words = count_words(len(turned), "shape turns", "shapes turn")
        message = (
            f"{words} tets inside out at weight 1, where flesh does not follow: {', '.join(named)}"
        )
        yield make_warning("tracks.turned", message, {"shapes": turned})


def _figures(face: TrackFace, own: OwnShapes, shots: list[TrackShot]) -> dict[str, Any]:
    model = face.model
    tracks = own.tracks
    shapes = []
    for number, name in enumerate(tracks.names):
        pose = face.targets.at(tracks.whole(name))
        shape = {
            "name": name,
            "jaw": tracks.jaw[number].round(5).tolist(),
            "teeth_mm": round(float(tracks.teeth_mm[number]), 4),
            "off_mm": round(float(tracks.off_mm[number]), 4),
            "turned_tets": _count_inverted(model, pose.target),
        }
        if name in own.left_mm:
            left = round(own.left_mm[name], 4)
            shape |= {"on_top_of": _sum_of(tracks, number), "left_mm": left}
        shapes.append(shape)
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
    }


def _sum_of(tracks: MuscleTracks, number: int) -> dict[str, float]:
    """Return the weights of the shapes that one of a person's own is on top of, by their names."""
    weights = zip(tracks.names, tracks.sums[number].round(4).tolist(), strict=True)
    return {name: weight for name, weight in weights if weight}


def _count_inverted(model: SubjectModel, x: Floats) -> int:
    """Return how many tets are inside out at x (p, 3): there flesh does not follow its target."""
    return int((volumes(x, model.tets) <= 0.0).sum())
