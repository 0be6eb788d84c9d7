"""The job that plays fitted performances, and keys of expressions, muscles and jaw."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from solver.animation.performance import PlayedPerformance
from solver.animation.tracks import PlayedShapes, TrackedShapes
from solver.fitting.calibration import read_muscles
from solver.fitting.face import Pose
from solver.fitting.strips import strip_names
from solver.jobs import Task
from solver.jobs.scenes import CARRIED, EXPORT, READ, fingerprint, finish, play, read_player
from solver.kinds.simulate import Simulate
from solver.progress import part_of
from solver.rig import Rig
from solver.scene import Stage
from solver.scene.document import (
    drives_of,
    moving_fibres,
    performances_of,
    shape_performance_of,
    track_drives_of,
)
from solver.scene.places import Places
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackContact


def run(task: Task[Simulate]) -> list[Path]:
    """Play performances and keys of a rig's expressions, of muscles and jaw on a fitted face.

    Where the scene says so, tracks drive the face by keys of their shapes, instead, and by one
    performance that was fitted by these.

    Frames that are ready are in ``out/frames``; with ``resume`` those that are there are kept and
    the simulation goes on after them. Raises :class:`InputError` (``scene.*``) for a scene that
    does not fit the person, ``options.video`` where there is no codec, and
    :class:`~solver.errors.SolveError` (``simulate.*``) where the flesh finds no way on.
    """
    given = task.options
    out = task.out
    progress = task.progress
    rig, places = read_player(task)
    by_tracks = given.scene.drive == "tracks"
    playing = part_of(progress, READ, EXPORT)
    make = partial(
        Stage,
        given.scene,
        places,
        rig.weights,
        linear=given.linear_solver,
        progress=part_of(playing, 0.0, CARRIED),
    )
    stage, more = (_by_tracks if by_tracks else _by_muscles)(task, rig, places, make)
    frames = play(stage, out, fingerprint(task), playing, resume=task.resume)
    return finish(stage, frames, out, progress, title="Simulation", video=given.video, more=more)


def _by_muscles(
    task: Task[Simulate], rig: Rig, places: Places, make: Callable[..., Stage]
) -> tuple[Stage, dict[str, Any]]:
    """Return a scene that a rig's expressions, performances and muscles play, and its figures."""
    given = task.options
    poses = {fit.name: Pose(fit.activations, fit.jaw) for fit in rig.expressions}
    file = task.inputs.get("fibre_muscles")
    known = None if file is None else read_muscles(file, rig.model)
    parts = (given.scene, poses)
    limits = rig.limits
    performances = performances_of(*parts, places, rig.weights, known, limits)
    fibres = moving_fibres(given.scene, performances, known)
    names = None if fibres is None else strip_names(rig.model.muscle_names, fibres)
    drives = drives_of(*parts, rig.model, rig.weights, performances, names, limits)
    firmer = 1.0 if performances is None else max(float(performances.curve.max()), 1.0)
    stage = make(drives, fibres=fibres, firmer=firmer)
    played = performances.performances if performances else ()
    return stage, {"performances": [*map(_told, played)]}


def _by_tracks(
    task: Task[Simulate], rig: Rig, places: Places, make: Callable[..., Stage]
) -> tuple[Stage, dict[str, Any]]:
    """Return a scene that the shapes of tracks play, and its figures."""
    given = task.options
    tracks = MuscleTracks.load(task.inputs["tracks"], rig.model)
    shapes = TrackedShapes.of(rig.model, tracks)
    played = shape_performance_of(given.scene, shapes, places)
    drives = track_drives_of(given.scene, shapes, places, played)
    stage = make(drives, firmer=TrackContact.firmer, tracks=tracks)
    told = [_told(played)] if played else []
    return stage, {"shapes": len(tracks.names), "performances": told}


def _told(played: PlayedPerformance | PlayedShapes) -> dict[str, Any]:
    """Return the figures of a performance."""
    times = len(played.times)
    bridged = played.bridged.tolist()
    return {"asset": played.entry.asset, "frames": times, "bridged": bridged}
