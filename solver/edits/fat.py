"""Fattening and slimming: flesh that grows without stress, as far as it is not muscle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solver.edits.edited import Edited
from solver.edits.ends import off_the_ends
from solver.edits.maps import into_volume
from solver.errors import InputError
from solver.surface import Floats

LEAST, MOST = 0.6, 1.5
"""Limits of a growth f: flesh grows to f^3 of its volume."""
SOFTENING = 3.0
"""Flesh that grew is softer by f to this power: the same tissue in more volume."""


@dataclass(frozen=True)
class Fat:
    """Growth f_i = f_min (1 - s_i0) + f_max s_i0 of F_p = f I, where a map says (SYSTEM: fat).

    Muscle grows by ``f_min``, passive flesh by ``f_max``; s_i0 is S's passive share of a tet.
    (0.9, 1.0) is slim, (1.0, 1.2) fat. A ``painted`` map (V,), see :mod:`solver.edits.maps`, draws
    f towards 1, and so do the ends of the model's flesh. Where f > 1 the stiffness is
    divided by f^``softening``; the exponent is ours.
    """

    f_min: float
    f_max: float
    painted: Floats | None = None
    softening: float = SOFTENING

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.fat`` for a growth out of all measure."""
        for factor in (self.f_min, self.f_max):
            if not LEAST <= factor <= MOST:
                raise InputError(
                    "scene.fat",
                    f"flesh grows by a factor between {LEAST} and {MOST}, not {factor}",
                    found=factor,
                )
        passive = before.S[:, [0]].toarray()[:, 0]
        whole = self.f_min * (1.0 - passive) + self.f_max * passive
        share = into_volume(before.model, self.painted) * off_the_ends(before.model)
        growth = 1.0 + (whole - 1.0) * share
        softer = np.maximum(growth, 1.0) ** -self.softening
        return replace(before, growth=before.growth * growth, stiffness=before.stiffness * softer)
