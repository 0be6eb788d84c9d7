"""How a neck shares out the head's rotation among its joints, without muscles.

The rotation vector of the head is split along the joints: joint k turns by the share of its axis.
As rotations do not add up, what is left over is shared out again until the head has its rotation.
Shares are those of measured necks (:attr:`solver.neck.anatomy.Neck.shares`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from solver.neck.anatomy import Neck, NeckPose
from solver.surface import Floats

ROUNDS = 20  # of sharing out what is left over, which each makes about four times less
CLOSE = 1e-7  # rad
FIXED = 1e-9  # rad, the half axis of the range where no joint turns


def share_out(neck: Neck, head: Floats, rounds: int = ROUNDS) -> NeckPose:
    """Return the pose whose head has the rotation ``head`` (3, 3) against the torso.

    All joints turn in proportion to their shares; nothing is bounded here (:func:`within`).
    Fewer ``rounds`` leave the head a little off, smoothly.
    """
    goal = Rotation.from_matrix(head)
    vector = goal.as_rotvec()
    for _ in range(rounds):
        pose = neck.pose(neck.shares * vector)
        left = (goal * Rotation.from_matrix(pose.head).inv()).as_rotvec()
        if np.abs(left).max() < CLOSE:
            break
        vector = vector + left
    return pose


def within(neck: Neck, head: Floats, part: float = 1.0) -> tuple[Floats, float]:
    """Return a rotation vector (3,) held within the range of motion, and by how much it is beyond.

    The range is an ellipsoid with :attr:`~solver.neck.anatomy.Neck.head_range` as half axes, of
    which ``part`` is allowed; the answer keeps the direction. The second value is rad, 0 within.
    """
    reach = float(np.linalg.norm(head / np.maximum(neck.head_range * part, FIXED)))
    if reach <= 1.0:
        return head, 0.0
    return np.asarray(head / reach), float(np.linalg.norm(head) * (1.0 - 1.0 / reach))
