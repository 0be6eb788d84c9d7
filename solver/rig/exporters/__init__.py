"""Exporters of a rig: each module of this package is one, by its name.

docs/develop/add-an-exporter.md adds one. Modules are imported when they are asked for, as some
need an extra.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, Protocol, cast

from pydantic import TypeAdapter, ValidationError

from solver.errors import InputError, quote
from solver.kinds.export_rig import FORMATS
from solver.rig.pictures import fit_picture
from solver.rig.report import report
from solver.rig.report.certificate import Certificate
from solver.rig.report.web_page import write_page
from solver.rig.rig import Rig
from solver.storage import write_json


class Exporter(Protocol):
    """Contents of an exporter's module."""

    FILE: str  # name of its file beside a rig
    MEDIA_TYPE: str
    WITH_EVERY_RIG: bool  # whether each fit writes it, so that it is one of the rig's artifacts
    Options: type[Any]  # a frozen dataclass of JSON values, all with defaults

    def write(self, rig: Rig, path: Path, options: Any) -> None:
        """Write the rig as ``path``; raises :class:`InputError` where it cannot."""

    def read_back(self, rig: Rig, path: Path, options: Any) -> dict[str, Any]:
        """Return how far the file is off the rig, as JSON values.

        Raises :class:`~solver.errors.SolveError` (``file.differs``) where that is too far.
        """


@dataclass(frozen=True)
class NoOptions:
    """Options of an exporter with nothing to choose."""


NO_OPTIONS = NoOptions()


def exporter(name: str) -> Exporter:
    """Return an exporter; raises :class:`InputError` (``export.unknown``, ``export.extra``)."""
    if name not in FORMATS:
        message = f"there is no exporter {name!r}; there are {', '.join(FORMATS)}"
        raise InputError("export.unknown", message, found=name, expected=list(FORMATS))
    try:
        return cast(Exporter, import_module(f"{__name__}.{name}"))
    except ModuleNotFoundError as error:
        raise InputError("export.extra", str(error), found=name) from error


def export(
    rig: Rig, name: str, path: Path | None = None, options: Mapping[str, Any] | None = None
) -> Path:
    """Write a rig as the exporter ``name`` does, and return the file: by default its ``FILE``.

    Raises :class:`InputError`: as :func:`exporter`, ``export.options`` for what its ``Options`` do
    not take, and as the exporter; :class:`~solver.errors.SolveError` (``file.differs``) for a file
    that shows another face than the rig.
    """
    return export_measured(rig, name, path, options).path


class Exported(NamedTuple):
    """A file that was written, and how far it is off its rig."""

    path: Path
    figures: dict[str, Any]


def export_measured(
    rig: Rig, name: str, path: Path | None = None, options: Mapping[str, Any] | None = None
) -> Exported:
    """Write a rig as :func:`export` does, and return what reading back has found, too."""
    chosen = exporter(name)
    file = path or Path(chosen.FILE)
    known = [each.name for each in fields(chosen.Options)]
    if strange := [each for each in options or {} if each not in known]:
        message = f"{name} has no setting {quote(strange[0])}: it has {', '.join(known) or 'none'}"
        raise InputError("export.options", message, found=quote(strange[0]), expected=known)
    try:
        given = TypeAdapter(chosen.Options).validate_json(json.dumps(options or {}), strict=True)
    except (TypeError, ValidationError) as error:
        raise InputError("export.options", f"options of {name}: {error}") from error
    file.parent.mkdir(parents=True, exist_ok=True)
    # beside it under its own name, by which faults call it: no reader sees half of a file
    with TemporaryDirectory(prefix=".part-", dir=file.parent) as folder:
        part = Path(folder) / file.name
        chosen.write(rig, part, given)
        figures = chosen.read_back(rig, part, given)
        part.replace(file)
    return Exported(file, figures)


def export_all(rig: Rig, folder: Path) -> list[Exported]:
    """Write what belongs to every rig into its folder, unless its extra is missing."""
    files = []
    for name in FORMATS:
        try:
            module = exporter(name)
        except InputError:
            continue
        if module.WITH_EVERY_RIG:
            files.append(export_measured(rig, name, folder / module.FILE))
    return files


# All files of a rig.


def write_rig(rig: Rig, certificate: Certificate, out: Path) -> list[Path]:
    """Write the rig into the folder ``out`` and return the paths of its files.

    These are those of all exporters that belong to every rig (``rig.npz``, ``rig.glb`` ...), those
    that show its systems, its parts for programs that read 0.1, its report, and a picture of each
    expression.
    """
    out.mkdir(parents=True, exist_ok=True)
    figures = report(rig, certificate)
    figures_file = out / "report.json"
    page = out / "report.html"
    exported = export_all(replace(rig, figures=figures), out)
    if rig.systems:
        exported.append(export_measured(rig, "systems", out / "systems.glb"))
    for letter in rig.systems:
        file = out / f"view_{letter}.bin"
        exported.append(export_measured(rig, "view", file, {"system": letter}))
    measured = {each.path.name: each.figures for each in exported}
    write_json(figures_file, {**figures, "files": measured})
    files = [*(each.path for each in exported), *rig.save_as_0_1(out)]
    pictures = [out / f"fit_{fit.name}.png" for fit in rig.shown]
    for fit, picture in zip(rig.shown, pictures, strict=True):
        fit_picture(rig.model, fit, picture)
    write_page(page, figures)
    return [*files, figures_file, page, *pictures]
