"""What the flesh is held by and meets, at one moment."""

from __future__ import annotations

from dataclasses import dataclass

from solver.surface import Floats


@dataclass(frozen=True)
class Boundary:
    """Held vertices (h, 3) in the order of ``Flesh.held``, jaw (5,), and objects' vertices (o, 3).

    All in the head's frame, mm.
    """

    held: Floats
    jaw: Floats
    objects: tuple[Floats, ...] = ()

    def toward(self, other: Boundary, part: float) -> Boundary:
        """Return the boundary ``part`` of the straight way to ``other``."""
        return Boundary(
            self.held + part * (other.held - self.held),
            self.jaw + part * (other.jaw - self.jaw),
            tuple(
                mine + part * (theirs - mine)
                for mine, theirs in zip(self.objects, other.objects, strict=True)
            ),
        )
