"""Where the flesh is and goes, and what one moment asks of it."""

from __future__ import annotations

from dataclasses import dataclass

from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class Motion:
    """Vertices x (p, 3) in mm and their velocities v (p, 3) in mm/s, in the world, and the head.

    ``head`` takes the subject's frame into the world; its scale is 1.
    """

    x: Floats
    v: Floats
    head: Similarity


@dataclass(frozen=True)
class Drive:
    """What a moment asks for: ``A`` (n, 6) per tet, ``jaw`` (5,), ``head`` into the world.

    ``time`` is in seconds, ``objects`` are vertices (o, 3) in the world, mm.
    """

    time: float
    A: Floats
    jaw: Floats
    head: Similarity
    objects: tuple[Floats, ...] = ()
