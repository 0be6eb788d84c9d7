"""The kinds of job that this release can do, each with its call of the solver's pipeline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from solver.pipeline import PersonFiles


@dataclass(frozen=True)
class Task:
    """A job as its call sees it: input files by role, scans or assets by name, and ``out``.

    ``how`` is what every call passes on: the options and whom to tell of progress.
    """

    files: dict[str, Path]
    captures: dict[str, Path]
    capture_role: str
    resume: bool
    out: Path
    how: dict[str, Any]


@dataclass(frozen=True)
class Call:
    """What a kind of job calls, and the file with its verdict or figures."""

    run: Callable[[Task], object]
    tells: str


def _check_scan(task: Task) -> None:
    from solver import pipeline

    files = task.files
    options = {**task.how["options"], "role": task.capture_role}
    pipeline.check_scan(
        files["scan"],
        task.out,
        template=files.get("template"),
        landmarks=files.get("landmarks"),
        **{**task.how, "options": options},
    )


def _register_scan(task: Task) -> None:
    from solver import pipeline

    files = task.files
    pipeline.register_scan(
        files["scan"],
        task.out,
        template=files.get("template"),
        neutral=files.get("neutral"),
        landmarks=files.get("landmarks"),
        **task.how,
    )


def _build_model(task: Task) -> None:
    from solver import pipeline

    files = task.files
    pipeline.build_model(files["neutral"], task.out, template=files.get("template"), **task.how)


def _fit_geometry(task: Task) -> None:
    from solver import pipeline

    pipeline.fit_geometry(task.files["model"], task.captures, task.out, **task.how)


def _fit_activations(task: Task) -> None:
    from solver import pipeline

    files = task.files
    pipeline.fit_activations(
        files["model"],
        files["weights"],
        task.captures,
        task.out,
        rig=files["rig"],
        **task.how,
    )


def _fit_sequence(task: Task) -> None:
    from solver import pipeline

    files = task.files
    pipeline.fit_sequence(
        files["model"],
        files["weights"],
        files["performance"],
        task.out,
        resume=task.resume,
        **task.how,
    )


def _build_preview(task: Task) -> None:
    from solver import pipeline

    files = task.files
    pipeline.build_preview(files["model"], files["weights"], files["rig"], task.out, **task.how)


def _simulate(task: Task) -> None:
    from solver import pipeline

    pipeline.simulate(_person(task), task.out, resume=task.resume, **task.how)


def _animate(task: Task) -> None:
    from solver import pipeline

    solved = task.files.get("blendshapes")
    pipeline.animate(_person(task), task.out, blendshapes=solved, resume=task.resume, **task.how)


def _edit(task: Task) -> None:
    from solver import pipeline

    pipeline.edit(_person(task), task.out, **task.how)


def _person(task: Task) -> PersonFiles:
    from solver.pipeline import PersonFiles

    files = task.files
    return PersonFiles(
        files["model"], files["weights"], files["rig"], task.captures, files.get("template")
    )


CALLS: dict[str, Call] = {
    "check_scan": Call(_check_scan, "check.json"),
    "register_scan": Call(_register_scan, "registration.json"),
    "build_model": Call(_build_model, "model.json"),
    "fit_geometry": Call(_fit_geometry, "report.json"),
    "fit_activations": Call(_fit_activations, "report.json"),
    "fit_sequence": Call(_fit_sequence, "sequence.json"),
    "build_preview": Call(_build_preview, "preview.json"),
    "simulate": Call(_simulate, "animation.json"),
    "animate": Call(_animate, "animation.json"),
    "edit": Call(_edit, "edit.json"),
}
