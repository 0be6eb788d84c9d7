"""The jobs that play a scene: on keys of expressions, muscles and jaw, or on a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import scipy.sparse as sp

from solver.anatomy.builtin import builtin_template
from solver.anatomy.template import Template
from solver.animation.blendshapes import (
    Blendshapes,
    Solved,
    expression_targets,
    solve_blendshapes,
)
from solver.animation.recording import from_recording
from solver.fitting.face import Face, Pose
from solver.fitting.model_checks import check_held
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.pipeline.common import Options, activations_file, take
from solver.pipeline.play import EXPORT, fingerprint, finish, play
from solver.progress import Progress, Step, silent
from solver.rig.animation_video import check_video
from solver.rig.result import load_activations, load_weights
from solver.scans.live_link import read_live_link
from solver.scene.document import check
from solver.scene.keys import head_of, keyed
from solver.scene.places import Places
from solver.scene.stage import Stage

DEFAULTS: dict[str, Any] = {"scene": {}, "video": False, "linear_solver": None}
READ = 0.02
SOLVED = 0.3
"""Parts of a job after which its files are read, and its blendshapes solved."""
SAVED_EVERY = 5
"""Blendshapes that are solved between two writings of their file."""


def simulate(
    model: Path,
    weights: Path,
    rig: Path,
    out: Path,
    *,
    assets: Mapping[str, Path] | None = None,
    template: Path | None = None,
    resume: bool = False,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Play keys of a rig's expressions, of muscles and of the jaw on a fitted face.

    ``weights`` is the rig's ``muscle_weights.npz`` and ``rig`` its ``activations.npz`` or its
    folder; ``template`` is the one that the model was made with (None: the built-in), whose
    landmarks the scene may name; ``assets`` are files that it names. Frames that are ready are in
    ``out/frames``; with ``resume`` those that are there are kept and the simulation goes on after
    them. Options: ``scene`` as docs/simulation.md has it, ``video`` (an MP4, too), and
    ``linear_solver``.

    Writes ``animation.glb``, ``animation.npz``, ``animation.png`` and ``animation.json``. Raises
    :class:`InputError` (``scene.*``) for a scene that does not fit the person,
    :class:`~solver.errors.SolveError` (``simulate.*``) where the flesh finds no way on; the frames
    before stay in ``out/frames``.
    """
    given = _options(options)
    scene = check(given["scene"], "simulate")
    person = _read(model, weights, assets, template, out, progress)
    expressions = activations_file(rig)
    fits = load_activations(expressions, person.model)
    poses = {fit.name: Pose(fit.activations, fit.jaw) for fit in fits}
    drives = keyed(scene, poses, person.model, person.S)
    stage = Stage(scene, person.places, person.S, drives, given["linear_solver"])
    files = [model, weights, expressions, *person.places.assets.values()]
    share = (READ, EXPORT)
    frames = play(stage, out, fingerprint(scene, files), progress, resume=resume, share=share)
    return finish(stage, frames, out, progress, title="Simulation", video=given["video"], more={})


def animate(
    model: Path,
    weights: Path,
    out: Path,
    *,
    assets: Mapping[str, Path] | None = None,
    template: Path | None = None,
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
    person = _read(model, weights, assets, template, out, progress)
    recording = scene["recording"]
    take = read_live_link(person.places.asset(recording["asset"]))
    kept = out / "blendshapes.npz"
    if blendshapes is None:
        anatomy = builtin_template() if template is None else Template.load(template)
        shapes = _solved(person, anatomy, kept, progress, resume=resume)
    else:
        shapes = Blendshapes.load(blendshapes, person.model)
    shapes.save(kept)
    drives = from_recording(
        take,
        shapes,
        person.model,
        recording.get("start", 0),
        recording.get("end"),
        head=head_of(scene.get("head", [])),
    )
    stage = Stage(scene, person.places, person.S, drives, given["linear_solver"])
    files = [model, weights, *person.places.assets.values()]
    share = (SOLVED, EXPORT)
    frames = play(stage, out, fingerprint(scene, files), progress, resume=resume, share=share)
    off = [shape.mean_mm for shape in shapes.shapes.values()]
    more = {
        "blendshapes": len(shapes.shapes),
        "blendshapes_mean_mm": sum(off) / len(off),
        "not_settled": [name for name, shape in shapes.shapes.items() if not shape.settled],
    }
    written = finish(
        stage, frames, out, progress, title="Animation", video=given["video"], more=more
    )
    return [*written, kept]


@dataclass(frozen=True)
class _Person:
    """A fitted face and the places on it."""

    model: SubjectModel
    S: sp.csr_array
    places: Places


def _options(options: Options) -> dict[str, Any]:
    """Return the options with their defaults; raises ``options.video`` where there is no codec."""
    given = take(options, DEFAULTS)
    if given["video"]:
        check_video()
    return given


def _read(
    model: Path,
    weights: Path,
    assets: Mapping[str, Path] | None,
    template: Path | None,
    out: Path,
    progress: Progress,
) -> _Person:
    out.mkdir(parents=True, exist_ok=True)
    progress(Step("read", 0.0, message=model.name))
    subject = SubjectModel.load(model)
    S = load_weights(weights, subject)
    return _Person(subject, S, Places.of(subject, template, assets or {}))


def _solved(
    person: _Person, template: Template, kept: Path, progress: Progress, *, resume: bool
) -> Blendshapes:
    """Solve the person's blendshapes; they are ``kept`` in a file as they come.

    With ``resume`` those in the file are taken as they are.
    """
    model = person.model
    targets = expression_targets(model, template.shapes)
    done: dict[str, Solved] = {}
    if resume and kept.is_file():
        done.update(Blendshapes.load(kept, model).shapes)

    def told(name: str, solved: Solved) -> None:
        done[name] = solved
        if len(done) % SAVED_EVERY == 0:
            Blendshapes(model.muscle_names, done).save(kept)
        fraction = READ + (SOLVED - READ) * len(done) / len(targets)
        words = f"{name}, {len(done)} of {len(targets)}"
        error = solved.mean_mm
        progress(Step("blendshapes", fraction, len(done), mean_error_mm=error, message=words))

    face = Face(model, linear=fastest())
    check_held(face)
    return solve_blendshapes(face, person.S, targets, dict(done), told)
