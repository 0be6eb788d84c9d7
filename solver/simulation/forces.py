"""Forces from outside: gravity, wind, points that are pulled."""

from __future__ import annotations

from typing import Protocol

from solver.simulation.state import Motion
from solver.surface import Floats


class Force(Protocol):
    """A force on the flesh; one millinewton is 1e6 of its units."""

    def at(self, motion: Motion, time: float) -> Floats:
        """Return the forces (p, 3) in the world at ``time`` in seconds, g mm/s^2."""
