"""Head motion out of an expression: what lies still on the skull stays where the neutral has it.

Rigid stabilisation after Beeler & Bradley, "Rigid stabilization of facial expressions" (SIGGRAPH
2014), with the expression's fitted shapes, instead of a skull, telling skin motion from head
motion.
"""

from __future__ import annotations

import numpy as np

from solver.similarity import IDENTITY, Similarity, weighted_motion
from solver.surface import Floats

STEPS = 6
SLACK_MM = 0.5


def head_motion(registered: Floats, expected: Floats, weights: Floats) -> Similarity:
    """Return the rigid motion that takes ``registered`` (n, 3) back onto ``expected`` (n, 3).

    ``weights`` (n,) say how still and how well seen each vertex is; vertices that move on their
    own by more than about :data:`SLACK_MM` lose their say.
    """
    used = np.flatnonzero(weights > 1e-3)
    if len(used) < 10:
        return IDENTITY
    motion = IDENTITY
    for _ in range(STEPS):
        away = np.linalg.norm(motion(registered[used]) - expected[used], axis=1)
        robust = weights[used] / (1 + (away / SLACK_MM) ** 2) ** 2
        motion = weighted_motion(registered[used], expected[used], robust)
    return motion
