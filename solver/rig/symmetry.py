"""How alike both sides of a face move: an expression's motion against its mirror image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.anatomy.embedding import at_nearest
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class SymmetryOptions:
    """What counts as moving alike on both sides."""

    percentile: float = 99.0  # of the face's vertices: a wink moves few of them
    most_mm: float = 0.5  # by which they are off the mirror image


SYMMETRY = SymmetryOptions()


def asymmetry_mm(
    model: SubjectModel, skin: Floats, options: SymmetryOptions = SYMMETRY
) -> float | None:
    """Return how far the motion of the face to ``skin`` (v, 3) is off its mirror image.

    That is a percentile over the face's vertices, those left out that ``skin`` does not show (NaN);
    None where none is left. The mirror is the jaw's middle plane.
    """
    neutral, across = model.skin.vertices, model.jaw.axes[0]
    motion, places = skin - neutral, neutral[model.face]
    mirrored = places - 2.0 * np.outer((places - model.jaw.origin) @ across, across)
    other = at_nearest(mirrored, model.skin, motion)
    off = motion[model.face] - other + 2.0 * np.outer(other @ across, across)
    known = np.linalg.norm(off, axis=1)
    known = known[np.isfinite(known)]
    return float(np.percentile(known, options.percentile)) if len(known) else None
