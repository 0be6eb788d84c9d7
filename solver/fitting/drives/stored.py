"""Drives as JSON values, in which a rig tells how it was fitted, and an artifact how solved."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from inspect import getmembers, isclass
from pkgutil import iter_modules
from typing import Any

import scipy.sparse as sp

from solver.errors import InputError, quote
from solver.fitting import drives
from solver.fitting.drives import MuscleDrive
from solver.model import SubjectModel


def store(drive: MuscleDrive) -> dict[str, Any]:
    """Return a drive as JSON values: its ``name`` and its settings."""
    return {"name": drive.name, **drive.settings()}


def restore(stored: Any, model: SubjectModel, S: sp.csr_array) -> MuscleDrive:
    """Return the drive that :func:`store` wrote, of the muscles of a model with S.

    Raises :class:`InputError` (``rig.drive``) for one that this release does not know.
    """
    name = str(stored.get("name")) if isinstance(stored, Mapping) else ""
    known = _known()
    if name not in known:
        message = f"the rig is driven by {quote(name)}, which this release does not know"
        raise InputError("rig.drive", message, found=quote(name), expected=sorted(known))
    settings = {key: value for key, value in stored.items() if key != "name"}
    try:
        return known[name].restored(settings, model, S)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        message = f"the rig's drive, {name}, has no such settings: {error}"
        raise InputError("rig.drive", message, found=quote(name)) from error


def are_same(first: MuscleDrive, second: MuscleDrive) -> bool:
    """Tell whether two drives of one person are stored alike."""
    return store(first) == store(second)


def _known() -> dict[str, type[MuscleDrive]]:
    """Return name -> drive, of every module beside this one."""
    found: dict[str, type[MuscleDrive]] = {}
    for part in iter_modules(drives.__path__):
        module = import_module(f"{drives.__name__}.{part.name}")
        classes: list[Any] = [each for _, each in getmembers(module, isclass)]
        # not those that it has from another module
        own = (each for each in classes if each.__module__ == module.__name__)
        found.update({each.name: each for each in own if MuscleDrive in each.__mro__})
    return found
