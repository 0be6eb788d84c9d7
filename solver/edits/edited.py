"""What edits make of a face: the only thing that simulations see of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.model import SubjectModel
from solver.surface import Floats

DENSITY = 1e-3
"""Of flesh, in g/mm^3: water's."""


@dataclass(frozen=True)
class Edited:
    """Per tet ``growth`` (n,), ``stiffness`` (n,) and ``density`` (n,) in g/mm^3.

    ``growth`` is f of F_p = f I, ``stiffness`` a factor. ``bones`` (p, 3) in mm is added to the
    rest of held vertices; ``S`` (n, m + 1) blends the activations.
    """

    growth: Floats
    stiffness: Floats
    density: Floats
    bones: Floats
    S: sp.csr_array

    @classmethod
    def nothing(cls, model: SubjectModel, S: sp.csr_array) -> Edited:
        """Return the face as it is."""
        tets = len(model.tets)
        return cls(
            np.ones(tets), np.ones(tets), np.full(tets, DENSITY), np.zeros_like(model.rest), S
        )
