"""What a muscle's slider does: the muscle shortens along its fibres, as muscles do.

A fit has six numbers a muscle, and uses them freely: seen by itself, a fitted activation may push
where the muscle would pull. So a slider is not the fit's but the muscle's: C_j, its contraction.
The amounts of an expression's activations A_e (m, 6), as differences from rest, are those that come
nearest to it,

    min over 0 <= c <= 1 of |sum_j c_j C_j - A_e|^2 in the norm J^T J + w I,

J being the skin's linear response at rest: what matters of an activation is what is seen of it. The
small w keeps what is hardly seen near the fits too.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.optimize

from solver.fitting.stretches import COLUMN, FROBENIUS, ROW
from solver.mechanics.flesh import IDENTITY
from solver.surface import Floats

FULL_STRETCH = 0.6
"""Length to which a slider at 1 shortens a muscle's fibres.

Well within what muscles can (half: :data:`solver.rig.plausibility.MUSCLE_SOURCE`), and on the
straight line from rest to there the muscle's volume is never off by more than 5 %.
"""

UNSEEN = 1e-2
"""The weight w, mm^2."""

JITTER = 1e-9
"""Part of the mean diagonal that makes a Gram matrix definite."""


def contraction(tensor: Floats) -> Floats:
    """Return the change (6,) of a muscle's activation that contracts it and keeps its volume.

    ``tensor`` (3, 3) is the mean of d d^T over the fibre directions d. Its deviator is the
    logarithmic strain, so that a ring shortens in its plane and thickens across.
    """
    values, axes = np.linalg.eigh(tensor)
    strain = 1.5 * np.log(FULL_STRETCH) * (values - values.mean()) / values.max()
    matrix = (axes * np.exp(strain)) @ axes.T
    return np.asarray(matrix[ROW, COLUMN] - IDENTITY)


def nearest_amounts(activations: Floats, contractions: Floats, seen: Floats) -> Floats:
    """Return the amounts (e, k), from 0 to 1, that come nearest to fitted activations.

    ``activations`` (e, 6 m) are differences from rest, ``contractions`` (6 m, k) the changes at 1,
    ``seen`` (6 m, 6 m) is J^T J in mm^2.
    """
    if not contractions.size:
        return np.zeros((len(activations), 0))
    norm = seen + UNSEEN * np.diag(np.tile(FROBENIUS, len(seen) // 6))
    gram = contractions.T @ norm @ contractions
    root = np.linalg.cholesky(gram + np.eye(len(gram)) * JITTER * np.trace(gram) / len(gram)).T
    right = scipy.linalg.solve_triangular(root, contractions.T @ norm @ activations.T, trans="T")
    return np.array([scipy.optimize.lsq_linear(root, each, (0.0, 1.0)).x for each in right.T])
