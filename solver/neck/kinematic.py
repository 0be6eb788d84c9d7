"""A head's motion shared among the joints of a neck, without muscles.

What is beyond the range of motion is held at it and counted; what turns too fast is counted alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.neck.anatomy import Neck
from solver.neck.posture import share_out, within
from solver.surface import Floats

MOST_DEG_S = 600.0  # a head that is flung turns by so much in a second


@dataclass(frozen=True, eq=False)
class SharedMotion:
    """Joints of a neck over time, and how far its goal was beyond them."""

    times: Floats  # (n,) s
    turns: Floats  # (n, 8, 3) rotation vectors of the joints, rad
    beyond: Floats  # (n,) rad beyond the range of motion, 0 within
    speed: Floats  # (n,) rad/s that the goal asks for


def share_motion(neck: Neck, times: Floats, goals: Floats) -> SharedMotion:
    """Return the joints that turn a head by ``goals`` (n, 3, 3) at ``times`` (n,) in s."""
    turns, beyond = np.empty((len(times), *neck.shares.shape)), np.empty(len(times))
    for number, vector in enumerate(Rotation.from_matrix(goals).as_rotvec()):
        held, beyond[number] = within(neck, vector)
        pose = share_out(neck, Rotation.from_rotvec(held).as_matrix())
        turns[number] = pose.turns
    return SharedMotion(times, turns, beyond, speeds(times, goals))


def speeds(times: Floats, goals: Floats) -> Floats:
    """Return how fast rotations (n, 3, 3) turn to each from the one before, (n,) rad/s."""
    steps = np.swapaxes(goals[:-1], 1, 2) @ goals[1:]
    angles = Rotation.from_matrix(steps).magnitude() if len(steps) else np.zeros(0)
    return np.concatenate([[0.0], angles / np.diff(times)])


def count_beyond(beyond: Floats, speed: Floats, most_deg_s: float = MOST_DEG_S) -> dict[str, Any]:
    """Return how many moments are out of range, or too fast, the first of each, and the worst."""
    fast = np.degrees(speed) > most_deg_s
    return {
        "out_of_range": int((beyond > 0.0).sum()),
        "first_out_of_range": _first(beyond > 0.0),
        "beyond_range_deg": round(float(np.degrees(beyond.max())), 2),
        "too_fast": int(fast.sum()),
        "first_too_fast": _first(fast),
        "fastest_deg_s": round(float(np.degrees(speed.max())), 1),
    }


def _first(chosen: Floats) -> int | None:
    return int(np.argmax(chosen)) if chosen.any() else None
