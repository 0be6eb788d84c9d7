"""The jobs that play a scene: on keys of expressions, muscles and jaw, or on a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

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
from solver.pipeline.common import Options, take
from solver.pipeline.person import Person, PersonFiles
from solver.pipeline.play import EXPORT, finish, play
from solver.progress import Progress, Step, silent
from solver.rig.animation_video import check_video
from solver.scans.live_link import read_live_link
from solver.scene.document import check
from solver.scene.keys import head_of, keyed
from solver.scene.stage import Stage

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
    the simulation goes on after them. Options: ``scene`` as docs/simulation.md has it, ``video``
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

    face = Face(model, linear=fastest())
    check_held(face)
    return solve_blendshapes(face, person.S, targets, dict(done), told)
