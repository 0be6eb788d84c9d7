"""How still each point of the face lies on the skull, by the model's own mechanics."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.fitting.sensitivity import Sensitivity
from solver.surface import Floats

EXCITED = 0.2
"""Change of an activation's entry that counts as usual."""
JAW_MOTION = np.array([0.2, 0.1, 3.0, 3.0, 3.0])
"""Usual motion of the jaw, rad and mm."""
MOBILE_MM = 0.4
"""Motion that halves a point's stillness."""


def stillness(face: Face, S: sp.csr_array) -> Floats:
    """Return weights (k,) in (0, 1] of the face's points: 1 where no muscle nor the jaw moves it.

    The motion is the linear response, at rest, to usual changes of every activation and of the
    jaw, all at once and independent of each other.
    """
    jacobian = Sensitivity(face, S, face.rest_state(S)).by_pose()
    columns = jacobian.flesh.shape[1]
    by_pose = np.zeros((face.model.rest.size, columns))
    by_pose[jacobian.free] = jacobian.flesh
    by_pose[jacobian.moving, -len(JAW_MOTION) :] = jacobian.jaw
    usual = np.concatenate([np.full(columns - len(JAW_MOTION), EXCITED), JAW_MOTION])
    motion = np.asarray(face.face_embedding @ (by_pose * usual).reshape(-1, 3 * columns))
    squares = np.sum(motion.reshape(len(motion), -1) ** 2, axis=1)
    return np.asarray(1.0 / (1.0 + squares / MOBILE_MM**2) ** 2)
