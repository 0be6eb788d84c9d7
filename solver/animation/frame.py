"""One moment of an animation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class PosedFrame:
    """Activations ``a`` (m, 6), ``jaw`` (5,), ``head`` into the world (scale 1), ``eyes`` (2, 3).

    Eyes, the subject's left one first, are rotation vectors in radians in the head's frame.
    ``clamped`` counts the muscles that were kept from folding (:mod:`solver.animation.blend`).
    """

    a: Floats
    jaw: Floats
    head: Similarity
    eyes: Floats
    clamped: int = 0


class Drives(Protocol):
    """What the face does at any time; ``times`` (f,) in seconds are those of its frames."""

    times: Floats

    def __call__(self, time: float) -> PosedFrame:
        """Return the pose at ``time`` in seconds, between frames too."""
