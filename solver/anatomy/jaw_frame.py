"""The frame of the mandible's five degrees of freedom."""

from __future__ import annotations

import numpy as np

from solver.model import JawFrame
from solver.surface import Floats


def jaw_frame(condyles: Floats) -> JawFrame:
    """Return the frame half way between the left and right condyle, ``condyles`` (2, 3) in mm.

    The first axis goes through the condyles to the subject's left, the second is the vertical made
    orthogonal to it, the third points forward.
    """
    lateral = condyles[0] - condyles[1]
    lateral = lateral / np.linalg.norm(lateral)
    vertical = np.array([0.0, 1.0, 0.0])
    vertical = vertical - (vertical @ lateral) * lateral
    vertical = vertical / np.linalg.norm(vertical)
    return JawFrame(
        condyles.mean(axis=0), np.stack([lateral, vertical, np.cross(lateral, vertical)])
    )
