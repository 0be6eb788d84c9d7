"""The jobs: a module for each kind, named as the kind, with ``run(task)``.

Each reads files, writes what it leaves into a folder and reports progress. A worker calls them in a
process of its own, the offline command line directly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from solver.errors import InputError, SolveError
from solver.kinds import KINDS, JobOptions, Kind, OptionsError
from solver.progress import ProgressCallback, silent

if TYPE_CHECKING:
    from solver.anatomy.template import Template
    from solver.kinds.live_channel import Channel

Given = TypeVar("Given", bound=JobOptions)


@dataclass(frozen=True)
class Task(Generic[Given]):
    """The order of a job, for the ``run`` of its kind's module.

    ``inputs`` are its files by name: ``scan`` with its ``landmarks``, ``neutral``, ``template``,
    ``model``, ``rig`` (of 0.1 with its ``model``, ``weights`` and ``report``: ``Rig.load`` reads
    either), ``start`` (another rig), ``performance``, ``markers`` (a take) with their
    ``marker_set`` and calibrated ``fibre_muscles``, ``blendshapes``, ``expression_basis``,
    ``tracks``, and the ``texture`` and ``normals`` of the neutral's registration.
    """

    out: Path  # the folder for what it leaves
    options: Given  # of its kind, with their defaults
    inputs: Mapping[str, Path] = field(default_factory=dict)
    # scans, photographs or assets by their names
    captures: Mapping[str, Path] = field(default_factory=dict)
    facts: Mapping[str, Path] = field(default_factory=dict)  # JSON beside photographs, by those
    masks: Mapping[str, Path] = field(default_factory=dict)  # PNG beside photographs, by those
    role: str = "unknown"  # that its scan is meant for: neutral, expression or unknown
    resume: bool = False  # whether to go on after what an earlier attempt left in ``out``
    progress: ProgressCallback = silent
    channel: Channel | None = None  # of a live session's messages


def run_job(
    kind: str,
    out: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    captures: Mapping[str, Path | str] | None = None,
    facts: Mapping[str, Path | str] | None = None,
    masks: Mapping[str, Path | str] | None = None,
    role: str = "unknown",
    resume: bool = False,
    progress: ProgressCallback = silent,
    channel: Channel | None = None,
    jobs: str = "solver.jobs",
    **inputs: Path | str | None,
) -> list[Path]:
    """Do a job of a kind and return the files that it leaves; see :class:`Task`.

    ``jobs`` is the package with a module for each kind. Raises :class:`InputError` for a kind that
    there is not (``job.kind``), options (``options.*``, ``scene.schema``), files that are not given
    (``job.missing``) or cannot be used, and
    :class:`~solver.errors.SolveError` where there is no solution (``solve.singular`` where a job
    has no word of its own for that).
    """
    if kind not in KINDS:
        message = f"there is no kind of job {kind!r}: there are {', '.join(KINDS)}"
        raise InputError("job.kind", message, expected=sorted(KINDS))
    given = _read_options(KINDS[kind], options or {})
    files = _Files({name: Path(path) for name, path in inputs.items() if path is not None})
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    scans, beside, shown = map(_as_paths, (captures, facts, masks))
    task = Task(folder, given, files, scans, beside, shown, role, resume, progress, channel)
    try:
        return cast(list[Path], import_module(f"{jobs}.{kind}").run(task))
    except ValueError as error:
        # not loaded before: threads that it starts could not be confined with the job
        from numpy.linalg import LinAlgError

        if not isinstance(error, LinAlgError):
            raise
        message = f"{KINDS[kind].title.lower()}: what was given has no one solution ({error})"
        raise SolveError("solve.singular", message) from error


def read_template(task: Task[Any]) -> Template:
    """Return the template that a task gives, else the built-in one."""
    # not loaded before: the command line asks for jobs' names alone
    from solver.anatomy.template import Template
    from solver.templates.builtin.build import builtin_template

    given = task.inputs.get("template")
    return builtin_template() if given is None else Template.load(given)


class _Files(dict[str, Path]):
    """The files of a job by name; one that is not given is told."""

    def __missing__(self, name: str) -> Path:
        """Raise :class:`InputError`."""
        given = ", ".join(self) or "no file"
        message = f"the job needs the file {name}, and was given {given}"
        raise InputError("job.missing", message, expected=name, found=sorted(self))


def _as_paths(files: Mapping[str, Path | str] | None) -> dict[str, Path]:
    return {name: Path(path) for name, path in (files or {}).items()}


def _read_options(kind: Kind, given: Mapping[str, Any]) -> JobOptions:
    try:
        return kind.read(given)
    except OptionsError as error:
        first = error.faults[0]
        known = sorted(kind.options.model_fields)
        option = str(first.path[0]) if first.path else ""
        where = first.where.removeprefix("options.")
        words = f"{where}: {first.message}"
        if option == "scene":
            raise InputError("scene.schema", words, where=where) from error
        if option not in known:
            raise InputError("options.unknown", words, expected=known) from error
        raise InputError(f"options.{option}", words) from error
