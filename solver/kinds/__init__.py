"""The contracts of all kinds of job, by name: a module of this package with a ``KIND`` is one.

They know no numerics, so that the API reads them as well as worker, command line and solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules

from solver.kinds.document import Fault
from solver.kinds.kind import BUILTIN_VERTICES, Input, JobOptions, Kind, OptionsError
from solver.kinds.packing import NOT_READABLE, check_directory, is_plainly_packed

__all__ = [
    "BUILTIN_VERTICES",
    "KINDS",
    "NOT_READABLE",
    "Fault",
    "Input",
    "JobOptions",
    "Kind",
    "OptionsError",
    "check_directory",
    "is_plainly_packed",
]


def _find() -> dict[str, Kind]:
    found = {}
    for name in sorted(module.name for module in iter_modules(__path__)):
        kind = getattr(import_module(f"{__name__}.{name}"), "KIND", None)
        if isinstance(kind, Kind):
            report = kind.report or f"{kind.leaves}.json"
            result, folder = kind.result or report, kind.folder or kind.leaves
            found[name] = replace(kind, name=name, report=report, result=result, folder=folder)
    return found


KINDS: Mapping[str, Kind] = _find()
