"""Fibre muscles: one activation each, from 0, relaxed, to 1, of fibres that also resist.

(Sifakis, Neverov, Fedkiw 2005; :mod:`solver.mechanics.fibre_muscle`.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.fitting.controls import Block, Spread
from solver.fitting.drives import MuscleDrive
from solver.fitting.drives.six_numbers import ACTIVATION_REACH
from solver.fitting.tet_forces import MatrixRates, MuscleRates, TetForces
from solver.mechanics.fibre_muscle import CURVE, Curve, FibreMuscles, driven_by_muscles
from solver.mechanics.flesh import Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class FibreDrive(MuscleDrive):
    """The activations (m,) of fibre ``muscles``."""

    muscles: FibreMuscles
    curve: Curve = CURVE

    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:  # noqa: ARG002
        """See :class:`~solver.fitting.drives.MuscleDrive`."""
        return Block(
            "fibres",
            np.zeros(len(self.muscles.strengths)),
            reach=ACTIVATION_REACH,
            lower=0.0,
            upper=1.0,
            spread=Spread(template=0.1, scans=0.1, nothing=0.3),
            role="muscles",
        )

    def attach(self, flesh: Flesh) -> Flesh:
        """See :class:`~solver.fitting.drives.MuscleDrive`."""
        return driven_by_muscles(flesh, self.muscles, self.curve)

    def controls(self, S: sp.csr_array, a: Floats) -> Floats:  # noqa: ARG002
        """See :class:`~solver.fitting.drives.MuscleDrive`."""
        return a

    def rates(self, forces: TetForces) -> MuscleRates:
        """See :class:`~solver.fitting.drives.MuscleDrive`."""
        return MatrixRates(forces.flesh.forces_by_control(forces.x, forces.controls))
