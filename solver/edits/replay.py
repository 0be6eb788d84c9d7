"""Expressions replayed on an edited person: the same activations in other flesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from solver.edits.edited import Edited
from solver.fitting.face import Face
from solver.mechanics.potential import Potential
from solver.similarity import IDENTITY as NO_MOTION
from solver.simulation.simulator import Simulator
from solver.simulation.state import Drive
from solver.surface import Floats

SECONDS = 1.0
"""The way from rest to an expression counts as taking so long, for friction."""
PARTS = 4
"""Steps of that way: in one of them lips would be pressed through each other, or buckle."""


@dataclass(frozen=True)
class Replayed:
    """An equilibrium: vertices ``x`` (p, 3), the ``skin`` (V, 3), both in mm, and the ``jaw`` (5,).

    ``inverted`` tets there are, and the ``seconds`` that it took to find from the person's rest.
    """

    x: Floats
    skin: Floats
    jaw: Floats
    inverted: int
    seconds: float


class Replay:
    """An edited person, quasi-static, from whose rest every expression starts.

    ``face`` has the edits' stiffness, growth and bones, ``potentials`` are its contacts. Raises
    :class:`~solver.errors.SolveError` where the edited person finds no rest.
    """

    def __init__(self, edited: Edited, face: Face, potentials: Sequence[Potential]) -> None:
        begun = perf_counter()
        self._face = face
        self._simulator = Simulator(face, potentials, [], dynamic=False, density=edited.density)
        self._drive = Drive(0.0, face.flesh.passive(), np.zeros(5), NO_MOTION)
        self._rest = self._simulator.rest(self._drive)
        self.neutral = self._replayed(self._rest.x, self._drive.jaw, perf_counter() - begun)
        """The edited person at rest."""

    def pose(self, A: Floats, jaw: Floats) -> Replayed:
        """Return the equilibrium for activations ``A`` (n, 6) of the tets and a ``jaw`` (5,).

        Raises :class:`~solver.errors.SolveError` if there is none.
        """
        begun = perf_counter()
        goal, motion, drive = Drive(SECONDS, A, jaw, NO_MOTION), self._rest, self._drive
        for part in np.arange(1, PARTS + 1) / PARTS:
            target = self._drive.toward(goal, float(part))
            motion, drive = self._simulator.step(motion, drive, target).motion, target
        return self._replayed(motion.x, jaw, perf_counter() - begun)

    def _replayed(self, x: Floats, jaw: Floats, seconds: float) -> Replayed:
        face = self._face
        return Replayed(x, face.whole_skin(x, jaw), jaw, face.flesh.inverted(x), seconds)
