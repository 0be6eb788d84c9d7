"""What it is for a muscle to shorten along its fibres: one activation from one stretch."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.stretches import COLUMN, ROW
from solver.model import SubjectModel
from solver.surface import Floats


def fibre_tensors(model: SubjectModel, volumes: Floats, S: sp.csr_array) -> Floats:
    """Return the mean of d d^T over every muscle's flesh, (m, 3, 3), d being unit fibre directions.

    NaN for muscles without flesh in S, which keeps the model's pattern, and without fibres.
    """
    out = np.zeros((model.muscle_count + 1, 3, 3))
    if model.fibres is not None:
        share = S.data * np.repeat(volumes, np.diff(S.indptr))
        outer = share[:, None, None] * model.fibres[:, :, None] * model.fibres[:, None, :]
        np.add.at(out, S.indices, outer)
    size = np.trace(out[1:], axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.divide(out[1:], size, out=np.full_like(out[1:], np.nan), where=size > 0.0))


def shortened(tensor: Floats, stretch: float) -> Floats:
    """Return the activation (6,) that brings fibres to ``stretch`` and keeps the muscle's volume.

    ``tensor`` (3, 3) is the mean of d d^T. Its deviator is the logarithmic strain: parallel fibres
    come to ``stretch``, those of a ring to its root in both directions of their plane, which
    thickens by 1 / ``stretch``; fibres of all directions do nothing.
    """
    values, axes = np.linalg.eigh(tensor)
    strain = 1.5 * np.log(stretch) * (values - values.mean()) / values.max()
    matrix = (axes * np.exp(strain)) @ axes.T
    return np.asarray(matrix[ROW, COLUMN])
