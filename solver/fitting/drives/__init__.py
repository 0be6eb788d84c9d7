"""Muscle drives: what the numbers of the muscles are, and what they do to the flesh.

A drive is one module with one class. :mod:`.six_numbers` is the published one, six numbers a muscle
that S blends; :mod:`.admissible` keeps these to what muscles can make; :mod:`.fibre_muscles` has
muscles that pull along their fibres. ``docs/develop/add-a-control.md`` adds one. :mod:`.stored` has
those that rigs keep.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import scipy.sparse as sp

from solver.errors import Finding
from solver.fitting.controls import Block
from solver.fitting.interior_point import FeasibleSet
from solver.fitting.tet_forces import MuscleRates, TetForces
from solver.mechanics.flesh import Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class ContractionMap:
    """Contractions of m muscles by their values: c_j = rates_j . (a_j - rest_j), 0 at rest.

    Contraction is the part of their length that fibres lose, of fibre muscles the activation.
    """

    rates: Floats  # (m, k) of the k values of each muscle; NaN without fibres
    volumes: Floats  # (m,) mm^3, by which compartments count in a whole muscle


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

    def feasible(self, model: SubjectModel, volumes: Floats, S: sp.csr_array) -> FeasibleSet | None:
        """Return the set that the values stay in, None if there is none but the block's box.

        ``volumes`` (n,) are the tets' at rest.
        """
        return None

    def contraction_map(
        self, model: SubjectModel, volumes: Floats, S: sp.csr_array
    ) -> ContractionMap | None:
        """Return the muscles' contractions by their values; None where these do not tell them.

        ``volumes`` (n,) are the tets' at rest.
        """
        return None

    def loosen(self, part: float) -> MuscleDrive | None:
        """Return the drive with its bounds ``part`` of the way to none that bind; 0 is the same.

        None for one that free activations cannot be brought into step by step: it has no bounds, or
        its values are others.
        """
        return None

    def lacks(self, model: SubjectModel) -> list[Finding]:
        """Return warnings of what a model does not have, so that the drive cannot do its part."""
        return []


def are_fibres(activations: Floats) -> bool:
    """Tell whether frames' stored activations (f, m) are of fibre muscles; S has (f, m, 6)."""
    return activations.ndim == 2
