"""Joints of a face: bones that move by some of the controls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from solver.fitting.controls import ANGLE_UNIT, Block, Spread
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw, JawMotion
from solver.mechanics.jaw_tracks import TRACK_FREEDOM, JawTracks
from solver.model import JawFrame
from solver.surface import Floats

JAW_UNITS = np.array([ANGLE_UNIT, ANGLE_UNIT, 1.0, 1.0, 1.0])
TURN_REACH = 0.1  # rad
JAW_DAMPING = 1e-3  # weight of D^2


@dataclass(frozen=True)
class Joint:
    """A bone's ``motion`` by the numbers of a ``block``."""

    motion: JawMotion
    block: Block
    is_free: bool  # the numbers are those that rigs hold, and the skin alone says where it is


def free_jaw(frame: JawFrame) -> Joint:
    """Return the jaw by b (5,): two angles, rad, and a translation, mm."""
    return Joint(FreeJaw(frame), jaw_block(), is_free=True)


def jaw_on_tracks(tracks: JawTracks) -> Joint:
    """Return the jaw on its tracks by (3,): an angle, rad, and two slides, mm."""
    units = np.array([ANGLE_UNIT, 1.0, 1.0])
    block = Block(
        "tracks",
        np.zeros(TRACK_FREEDOM),
        damping=units**2 * JAW_DAMPING,
        reach=np.array([TURN_REACH, np.inf, np.inf]),
        lower=tracks.lower,
        upper=tracks.upper,
        units=units,
        usual=np.array([0.2, 3.0, 3.0]),
        spread=Spread(*map(_on_tracks, (0.03, 0.06, 0.2), (0.5, 1.0, 3.0))),
        role="joint",
    )
    return Joint(tracks, block, is_free=False)


@cache
def jaw_block() -> Block:
    """Return the block of the free jaw."""
    loose = np.array([0.2, 0.1, 3.0, 3.0, 3.0])
    return Block(
        "jaw",
        np.zeros(JAW_FREEDOM),
        damping=JAW_UNITS**2 * JAW_DAMPING,
        reach=np.array([TURN_REACH, TURN_REACH, np.inf, np.inf, np.inf]),
        units=JAW_UNITS,
        usual=loose,
        spread=Spread(
            np.array([0.03, 0.03, 0.5, 0.5, 0.5]), np.array([0.06, 0.03, 1.0, 1.0, 1.0]), loose
        ),
        role="joint",
    )


def _on_tracks(angle: float, slide: float) -> Floats:
    return np.array([angle, slide, slide])
