"""The frame of the mandible's five degrees of freedom, and how well it follows a known motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from solver.anatomy.warp import similarity
from solver.mechanics import jaw
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


@dataclass(frozen=True)
class JawResidual:
    """What five degrees of freedom ``b`` (5,) miss of a motion of the lower teeth, in mm.

    ``rms`` and ``greatest`` are distances to the teeth in the closest rigid motion, and
    ``not_rigid`` is what that motion itself misses (root mean square): a linear face model
    stretches other people's teeth when it turns them, and no jaw follows that.
    """

    b: Floats
    rms: float
    greatest: float
    not_rigid: float


def jaw_residual(frame: JawFrame, rest: Floats, moved: Floats) -> JawResidual:
    """Fit the jaw to points ``rest`` (k, 3) that moved to ``moved`` (k, 3), in mm."""
    rotation = similarity(rest, moved)[1]
    rigid = (rest - rest.mean(axis=0)) @ rotation.T + moved.mean(axis=0)
    freedom = jaw.DEGREES_OF_FREEDOM
    fit = least_squares(
        lambda b: (jaw.move(frame, rest, b) - rigid).ravel(),
        np.zeros(freedom),
        lambda b: jaw.jacobian(frame, rest, b).reshape(-1, freedom),
    )
    missed = np.linalg.norm(jaw.move(frame, rest, fit.x) - rigid, axis=1)
    return JawResidual(
        b=fit.x,
        rms=float(np.sqrt(np.mean(missed**2))),
        greatest=float(missed.max()),
        not_rigid=float(np.sqrt(np.mean(np.sum((moved - rigid) ** 2, axis=1)))),
    )
