"""Shared by jobs that play a template's shapes: the person's blendshapes, known or solved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import ShapeBasis
from solver.animation.blendshapes import Blendshapes, Solved, expression_targets, solve_blendshapes
from solver.fitting.drives.stored import are_same
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.fitting.face import Face
from solver.fitting.target_checks import check_held
from solver.jobs import Task, read_template
from solver.jobs.fits import JobPart, solve_basis
from solver.jobs.scenes import READ
from solver.mechanics.linear import fastest
from solver.progress import Step
from solver.rig import Rig
from solver.surface import Floats

FILE = "blendshapes.npz"
BASIS = 0.1  # part of a job after which its basis is solved, if none was left
SOLVED = 0.3  # part of a job after which its blendshapes are solved
SAVED_EVERY = 5  # blendshapes that are solved between two writings of their file


def person_blendshapes(task: Task[Any], rig: Rig) -> Blendshapes:
    """Return the person's blendshapes: those that were given, else or where outdated solved now.

    They are left beside the job's files, with the basis of expressions that they begin with, by
    :func:`left_files`. Raises ``blendshapes.*`` and ``basis.*``.
    """
    model = rig.model
    S = rig.weights
    kept = task.out / FILE
    shapes = None
    if "blendshapes" in task.inputs:
        shapes = Blendshapes.load(task.inputs["blendshapes"], model, S)
    if shapes is not None and not are_same(shapes.drive, rig.drive):
        shapes = None  # solved by a release without limits
    if shapes is None or shapes.outdated:
        shapes = _solve(task, rig, kept, shapes.shapes if shapes else {})
    shapes.save(kept, model, S)
    return shapes


def left_files(task: Task[Any]) -> list[Path]:
    """Return the files that :func:`person_blendshapes` has left."""
    return [file for file in (task.out / FILE, task.out / BASIS_FILE) if file.is_file()]


def tell_blendshapes(shapes: Blendshapes) -> dict[str, Any]:
    """Return what a report says of a person's blendshapes."""
    solved = shapes.shapes
    return {
        "blendshapes": len(solved),
        "blendshapes_mean_mm": float(np.mean([shape.mean_mm for shape in solved.values()])),
        "not_settled": [name for name, shape in solved.items() if not shape.settled],
    }


def _solve(task: Task[Any], rig: Rig, kept: Path, given: Mapping[str, Solved]) -> Blendshapes:
    """Solve the person's blendshapes but those ``given`` or left of a resumed job.

    The file is ``kept`` up.
    """
    model = rig.model
    S = rig.weights
    anatomy = read_template(task)
    targets = expression_targets(model, anatomy.shapes)
    done = dict(given)
    if task.resume and kept.is_file():
        known = Blendshapes.load(kept, model, S)
        done.update(known.shapes if are_same(known.drive, rig.drive) else {})

    def report(name: str, solved: Solved) -> None:
        done[name] = solved
        if len(done) % SAVED_EVERY == 0:
            Blendshapes(model.muscle_names, done, rig.drive).save(kept, model, S)
        count = len(done)
        error = solved.mean_mm
        fraction = BASIS + (SOLVED - BASIS) * count / len(targets)
        words = f"{name}, {count} of {len(targets)}"
        task.progress(Step("blendshapes", fraction, count, mean_error_mm=error, message=words))

    face = rig.face(fastest())
    check_held(face)
    begin = _known_changes(task, face, anatomy.shapes) if targets.keys() - done.keys() else {}
    return solve_blendshapes(face, targets, dict(done), report, begin)


def _known_changes(task: Task[Any], face: Face, shapes: ShapeBasis | None) -> dict[str, Floats]:
    """Return name -> the change of the controls that makes an expression about."""
    assert shapes is not None, "there are targets, so the template has shapes"
    basis = solve_basis(task, face, shapes.expressions, JobPart(READ, BASIS))
    return dict(zip(shapes.expression_names, basis.whole, strict=True))
