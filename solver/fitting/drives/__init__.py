"""Muscle drives: what the numbers of the muscles are, and what they do to the flesh.

A drive is one module with one class. :mod:`.six_numbers` is the published one, six numbers a muscle
that S blends; :mod:`.admissible` keeps these to what muscles can make; :mod:`.fibre_muscles` has
muscles that pull along their fibres. ``docs/develop/add-a-control.md`` adds one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from typing import Any, Protocol

import scipy.sparse as sp

from solver.errors import InputError, quote
from solver.fitting.controls import Block
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.tet_forces import MuscleRates, TetForces
from solver.mechanics.flesh import Flesh
from solver.model import SubjectModel
from solver.surface import Floats


class MuscleDrive(Protocol):
    """A kind of control of the muscles; it holds no state of a fit."""

    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        """Return the block of its values: rest, bounds, units, and the price of shapes."""

    def attach(self, flesh: Flesh) -> Flesh:
        """Return a flesh that is driven by :meth:`controls`, from one driven by activations."""

    def controls(self, S: sp.csr_array, a: Floats) -> Floats:
        """Return what drives the flesh for values ``a``, in the shape of the block's rest."""

    def rates(self, forces: TetForces) -> MuscleRates:
        """Return the forces' derivative by the values."""


# name in files -> its class, and how it is made of what is stored: a rig knows how it was fitted
DRIVES: Mapping[str, tuple[type, Callable[[Mapping[str, Any]], MuscleDrive]]] = {
    "free": (SixNumbers, lambda _: SixNumbers()),
    "admissible": (Admissible, lambda stored: Admissible(AdmissibleLimits(**stored["limits"]))),
}


def are_fibres(activations: Floats) -> bool:
    """Tell whether frames' stored activations (f, m) are of fibre muscles; S has (f, m, 6)."""
    return activations.ndim == 2


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
