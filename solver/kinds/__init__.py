"""The contracts of all kinds of job, by name: a module of this package with a ``KIND`` is one.

They know no numerics, so that the API reads them as well as worker, command line and solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from inspect import getdoc
from pkgutil import iter_modules

from solver.kinds.document import Fault
from solver.kinds.formats import NOT_READABLE, check_directory, format_number, is_plainly_packed
from solver.kinds.inputs import (
    FILES,
    INPUTS,
    LANDMARKS,
    MOST_FILM_FRAMES,
    MOST_PHOTOS,
    ROLES,
    SCANS,
    InputPart,
    LeftFile,
    Role,
)
from solver.kinds.kind import BUILTIN_VERTICES, JobOptions, Kind, OptionsError

__all__ = [
    "BUILTIN_VERTICES",
    "FILES",
    "INPUTS",
    "KINDS",
    "LANDMARKS",
    "MOST_FILM_FRAMES",
    "MOST_PHOTOS",
    "NOT_READABLE",
    "ROLES",
    "SCANS",
    "Fault",
    "InputPart",
    "JobOptions",
    "Kind",
    "LeftFile",
    "OptionsError",
    "Role",
    "check_directory",
    "format_number",
    "is_plainly_packed",
]


def _find() -> dict[str, Kind]:
    names = sorted(module.name for module in iter_modules(__path__))
    modules = {name: import_module(f"{__name__}.{name}") for name in names}
    return {
        name: _complete(name, module.KIND, getdoc(module) or "")
        for name, module in modules.items()
        if hasattr(module, "KIND")
    }


def _complete(name: str, kind: Kind, words: str) -> Kind:
    """Return a kind with what its module's name and docstring say of it, and what follows."""
    title, _, description = words.partition("\n\n")
    report = kind.report or f"{kind.leaves}.json"
    variants = tuple((option, _complete(name, each, words)) for option, each in kind.variants)
    return replace(
        kind,
        name=name,
        title=title.rstrip("."),
        description=" ".join(description.split()),
        report=report,
        result=kind.result or report,
        folder=kind.folder or kind.leaves,
        variants=variants,
    )


KINDS: Mapping[str, Kind] = _find()
