"""Flesh that is stiffer or softer, heavier or lighter, where a map says."""

from __future__ import annotations

from dataclasses import dataclass, replace

from solver.edits.edited import Edited
from solver.edits.maps import into_volume
from solver.errors import InputError
from solver.surface import Floats

MOST = 100.0
"""A factor of stiffness or density is at most this, and at least one over it."""


@dataclass(frozen=True)
class Stiffness:
    """Stiffness times ``factor``^u, u being the tet's share of a ``painted`` map (V,)."""

    factor: float
    painted: Floats | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.factor``."""
        change = _change(before, self.factor, self.painted)
        return replace(before, stiffness=before.stiffness * change)


@dataclass(frozen=True)
class Density:
    """Density times ``factor``^u, u being the tet's share of a ``painted`` map (V,)."""

    factor: float
    painted: Floats | None = None

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.factor``."""
        change = _change(before, self.factor, self.painted)
        return replace(before, density=before.density * change)


def _change(before: Edited, factor: float, painted: Floats | None) -> Floats:
    if not 1.0 / MOST <= factor <= MOST:
        raise InputError(
            "scene.factor",
            f"a factor lies between {1.0 / MOST} and {MOST:g}, not at {factor}",
            found=factor,
        )
    share: Floats = factor ** into_volume(before.model, painted)
    return share
