"""Where the flesh is and goes, and what one moment asks of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

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

    @property
    def y(self) -> Floats:
        """Return the vertices (p, 3) in the head's frame."""
        return self.head.inverse()(self.x)


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

    def toward(self, other: Drive, part: float) -> Drive:
        """Return what to ask for ``part`` of the way to ``other``, the head turning steadily."""
        if part == 1.0:
            return other
        turn = Rotation.from_matrix(self.head.rotation.T @ other.head.rotation).as_rotvec()
        rotation = self.head.rotation @ Rotation.from_rotvec(part * turn).as_matrix()
        shift = self.head.shift + part * (other.head.shift - self.head.shift)
        return Drive(
            self.time + part * (other.time - self.time),
            self.A + part * (other.A - self.A),
            self.jaw + part * (other.jaw - self.jaw),
            Similarity(1.0, np.asarray(rotation), shift),
            tuple(
                mine + part * (theirs - mine)
                for mine, theirs in zip(self.objects, other.objects, strict=True)
            ),
        )
