"""The job that edits a person: fatter, older, operated on, paralysed; and all expressions again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from solver.edits import Edited, EditReplay, Replayed, apply
from solver.errors import SolveError
from solver.fitting.target_checks import check_held
from solver.jobs import Task
from solver.jobs.scenes import read_person
from solver.kinds.edit import Edit
from solver.progress import ProgressCallback, Step
from solver.rig import ExpressionFit
from solver.rig.report.edit_report import (
    EditedExpression,
    EditedPerson,
    edit_picture,
    edit_report,
    write_edit,
)
from solver.scene import Physics, edit_of


def run(task: Task[Edit]) -> list[Path]:
    """Edit a person, and replay the rig's expressions before and after.

    Raises :class:`InputError` (``scene.*``) for a scene that does not fit the person,
    :class:`SolveError` where the edited person finds no rest. An expression that finds none is
    told, and left out.
    """
    entries = task.options.scene.edits
    physics = Physics(task.options.scene)
    out = task.out
    progress = task.progress
    rig, places = read_person(task)
    fits = rig.expressions
    unedited = Edited.nothing(rig.model, rig.weights)
    edited = apply([edit_of(entry, places) for entry in entries], rig.model, rig.weights)
    before, all_before = _replay(unedited, physics, fits, "before the edits", 0.05, progress)
    after, all_after = _replay(edited, physics, fits, "after the edits", 0.45, progress)
    compared = [
        EditedExpression(fit.name, one, other, fit.skin)
        for fit, one, other in zip(fits, all_before, all_after, strict=True)
    ]
    whole = EditedPerson(edited, before, after, compared)
    progress(Step("export", 0.86))
    report = edit_report(whole)
    files = [*write_edit(whole, report, out), out / "edit.png"]
    title = "Edited: " + ", ".join(dict.fromkeys(entry.kind for entry in entries))
    edit_picture(whole, title, _detail(report), files[-1])
    progress(Step("done", 1.0))
    return files


def _replay(
    person: Edited,
    physics: Physics,
    fits: Sequence[ExpressionFit],
    words: str,
    begin: float,
    progress: ProgressCallback,
) -> tuple[Replayed, list[Replayed | None]]:
    """Return a person at rest and in every expression, None for one that finds no rest."""
    progress(Step("rest", begin, message=words))
    face = physics.face(person)
    check_held(face)
    replay = EditReplay(person, face, physics.contacts(person))
    found: list[Replayed | None] = []
    for number, fit in enumerate(fits, start=1):
        done = begin + 0.4 * number / len(fits)
        try:
            found.append(replay.pose(physics.activations(person, fit.activations), fit.jaw))
        except SolveError as error:
            found.append(None)
            progress(Step("warning", done, message=f"{fit.name}, {words}: {error.message}"))
        progress(Step("expressions", done, number, message=f"{fit.name}, {words}"))
    return replay.neutral, found


def _detail(report: Mapping[str, Any]) -> str:
    volume = report["volume"]
    drift = report["drift_mm"]
    words = (
        f"volume {volume['change_ml']:+.1f} ml ({volume['change_percent']:+.1f} %), the face at "
        f"rest moves {report['neutral']['moved_mm']:.2f} mm on average"
    )
    return words if drift is None else f"{words}, expressions drift {drift:.2f} mm"
