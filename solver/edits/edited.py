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
    """An edited person: anatomy, and what became of the flesh.

    model
        The person; bones that were moved, and the skin vertices that stay with them (teeth), are
        where they are now. Its flesh, ``rest`` included, is as it was.
    unedited
        The person before all edits.
    growth, stiffness, density
        (n,) per tet: f of F_p = f I, a factor of the material's stiffness, and g/mm^3.
    bones
        (p, 3) in mm, added to the rest of vertices on bones: held ones and those that slide.
    S
        (n, m + 1) blends the activations.
    """

    model: SubjectModel
    unedited: SubjectModel
    growth: Floats
    stiffness: Floats
    density: Floats
    bones: Floats
    S: sp.csr_array

    @classmethod
    def nothing(cls, model: SubjectModel, S: sp.csr_array) -> Edited:
        """Return the face as it is."""
        ones = np.ones(len(model.tets))
        return cls(model, model, ones, ones, DENSITY * ones, np.zeros_like(model.rest), S)
