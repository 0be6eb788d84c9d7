"""Flesh that has mass and is pulled: one step of backward Euler as a minimum.

    E(y, a) + 1/(2 h^2) |y - z|^2_M + c/(2 h) |y - y_t|^2_M - f . y

Backward Euler's equation is where the derivative of this incremental potential is zero (Phace, eq.
11; Li et al. 2020, eq. 2). z = y_t + h v_t is where the flesh would fly without forces, M the
lumped mass, c the damping of motion in the head's frame, f the forces from outside. All are in the
head's frame: where a rigidly moved world puts z there, no fictitious forces are missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from solver.mechanics.flesh import Flesh
from solver.mechanics.terms import Springs
from solver.similarity import Similarity
from solver.surface import Floats


def lumped_masses(flesh: Flesh, density: Floats) -> Floats:
    """Return every vertex's mass (p,) in g, a quarter of its tets'; ``density`` (n,) in g/mm^3."""
    quarters = np.repeat(density * flesh.volumes / 4.0, 4)
    return np.asarray(np.bincount(flesh.tets.ravel(), quarters, len(flesh.rest)), np.float64)


class Inertia(Springs):
    """Springs of every free vertex of a flesh: what inertia and damping of one step amount to.

    Springs and load are zero until they are set.
    """

    def __init__(self, flesh: Flesh) -> None:
        super().__init__(flesh.rest, flesh.free)

    def release(self) -> None:
        """Take springs and load away."""
        self.stiffness = np.zeros_like(self.stiffness)
        self.load = np.zeros_like(self.load)

    def launch(
        self, masses: Floats, y: Floats, flight: Floats, seconds: float, damping: float
    ) -> None:
        """Set the springs of a step: from y (p, 3), where ``flight`` (p, 3) is z.

        ``masses`` (p,) are in g, ``damping`` is in 1/s.
        """
        inertia, drag = 1.0 / seconds**2, damping / seconds
        self.stiffness = (inertia + drag) * masses
        self.centre = (inertia * flight + drag * y) / (inertia + drag)


# Where the flesh is and goes, and what one moment asks of it.


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
    """Input of a moment: ``A`` (n, 6) per tet, ``jaw`` (5,), ``head`` into the world.

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
