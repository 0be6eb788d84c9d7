"""Exporters of a rig: each module of this package is one, by its name.

docs/develop/add-an-exporter.md adds one. Modules are imported when they are asked for, as some
need an extra.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from solver.errors import InputError
from solver.rig.rig import Rig


class Exporter(Protocol):
    """Contents of an exporter's module.

    FILE
        Name of its file beside a rig.
    MEDIA_TYPE
        Of that file.
    WITH_EVERY_RIG
        Whether each fit writes it, so that it is one of the rig's artifacts.
    Options
        A frozen dataclass of JSON values, all with defaults.
    """

    FILE: str
    MEDIA_TYPE: str
    WITH_EVERY_RIG: bool
    Options: type[Any]

    def write(self, rig: Rig, path: Path, options: Any) -> None:
        """Write the rig as ``path``; raises :class:`InputError` where it cannot."""


EXPORTERS: Mapping[str, str] = {
    each.name: f"{__name__}.{each.name}" for each in pkgutil.iter_modules(__path__)
}


def exporter(name: str) -> Exporter:
    """Return an exporter; raises :class:`InputError` (``export.unknown``, ``export.extra``)."""
    if name not in EXPORTERS:
        raise InputError(
            "export.unknown",
            f"there is no exporter {name!r}; there are {', '.join(EXPORTERS)}",
            found=name,
            expected=list(EXPORTERS),
        )
    try:
        return cast(Exporter, import_module(EXPORTERS[name]))
    except ModuleNotFoundError as error:
        raise InputError("export.extra", str(error), found=name) from error


def export(
    rig: Rig, name: str, path: Path | None = None, options: Mapping[str, Any] | None = None
) -> Path:
    """Write a rig as the exporter ``name`` does, and return the file: by default its ``FILE``.

    Raises :class:`InputError`: as :func:`exporter`, ``export.options`` for what its ``Options`` do
    not take, and as the exporter.
    """
    chosen = exporter(name)
    file = path or Path(chosen.FILE)
    try:
        given = chosen.Options(**(options or {}))
    except TypeError as error:
        raise InputError("export.options", f"options of {name}: {error}") from error
    file.parent.mkdir(parents=True, exist_ok=True)
    chosen.write(rig, file, given)
    return file


def write_all(rig: Rig, folder: Path) -> list[Path]:
    """Write what belongs to every rig into its folder, and return the files."""
    chosen = [(name, module) for name in EXPORTERS if (module := _find_offer(name))]
    return [export(rig, name, folder / module.FILE) for name, module in chosen]


def _find_offer(name: str) -> Exporter | None:
    """Return an exporter if each fit writes it; one whose extra is not there is left out."""
    try:
        module = exporter(name)
    except InputError:
        return None
    return module if module.WITH_EVERY_RIG else None
