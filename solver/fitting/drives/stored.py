"""Drives as JSON values, in which a rig tells how it was fitted, and an artifact how solved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

from solver.errors import InputError, quote
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits
from solver.fitting.drives.six_numbers import SixNumbers

# name in files -> its class, and how it is made of what is stored
DRIVES: Mapping[str, tuple[type, Callable[[Mapping[str, Any]], MuscleDrive]]] = {
    "free": (SixNumbers, lambda _: SixNumbers()),
    "admissible": (Admissible, lambda stored: Admissible(AdmissibleLimits(**stored["limits"]))),
}


def store(drive: MuscleDrive) -> dict[str, Any]:
    """Return a drive as JSON values: its ``name`` and its fields."""
    [name] = (name for name, (kind, _) in DRIVES.items() if kind is type(drive))
    assert is_dataclass(drive)
    return {"name": name, **asdict(drive)}


def restore(stored: Mapping[str, Any]) -> MuscleDrive:
    """Return the drive that :func:`store` wrote.

    Raises :class:`InputError` (``rig.drive``) for one that this release does not know.
    """
    name = str(stored.get("name"))
    if name not in DRIVES:
        message = f"the rig is driven by {quote(name)}, which this release does not know"
        raise InputError("rig.drive", message, found=quote(name), expected=list(DRIVES))
    try:
        return DRIVES[name][1](stored)
    except (LookupError, TypeError) as error:
        message = f"the rig's drive, {name}, has no such limits: {error}"
        raise InputError("rig.drive", message, found=quote(name)) from error
