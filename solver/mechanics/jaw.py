"""The mandible's rigid motion: five degrees of freedom b."""

from __future__ import annotations

import numpy as np

from solver.model import JawFrame
from solver.surface import Floats

DEGREES_OF_FREEDOM = 5  # hinge, sideways, and three of translation


def _rotation(axis: Floats, angle: float) -> tuple[Floats, Floats]:
    """Return the rotation about a unit axis (Rodrigues) and its derivative by the angle."""
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    square = skew @ skew
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.eye(3) + sine * skew + (1 - cosine) * square, cosine * skew + sine * square


def rotation(frame: JawFrame, b: Floats) -> Floats:
    """Return the mandible's rotation (3, 3) for b (5,): hinge first, then sideways."""
    return _rotation(frame.axes[1], b[1])[0] @ _rotation(frame.axes[0], b[0])[0]


def move(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Move points (k, 3) with the mandible by b (5,), in rad and mm."""
    return (points - frame.origin) @ rotation(frame, b).T + frame.origin + b[2:] @ frame.axes


def move_back(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Undo :func:`move`: return points (k, 3) of the head as seen from the mandible at b (5,)."""
    return (points - frame.origin - b[2:] @ frame.axes) @ rotation(frame, b) + frame.origin


def jacobian(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Return d move / db, shape (k, 3, 5)."""
    hinge, hinge_rate = _rotation(frame.axes[0], b[0])
    side, side_rate = _rotation(frame.axes[1], b[1])
    arms = points - frame.origin
    out = np.empty((len(points), 3, DEGREES_OF_FREEDOM))
    out[:, :, 0] = arms @ (side @ hinge_rate).T
    out[:, :, 1] = arms @ (side_rate @ hinge).T
    out[:, :, 2:] = frame.axes.T
    return out
