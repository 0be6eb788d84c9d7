"""Where the head is: keys of its turns and shifts, about a pivot in the neck."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from solver.animation.tracks import Interpolation, track
from solver.model import SubjectModel
from solver.similarity import Similarity
from solver.surface import Floats

BELOW_JAW_MM, BEHIND_JAW_MM = 40.0, 20.0
"""Where heads turn, from the middle of the jaw's condyles: about the upper neck."""


@dataclass(frozen=True)
class HeadKey:
    """At ``time`` in s the head is turned by ``rotation`` (3,), a vector in rad, and moved.

    ``shift`` (3,) is in mm.
    """

    time: float
    rotation: Floats
    shift: Floats


def neck(model: SubjectModel) -> Floats:
    """Return the point (3,) about which the subject's head turns, mm."""
    return np.asarray(model.jaw.origin - [0.0, BELOW_JAW_MM, BEHIND_JAW_MM])


def turned(pivot: Floats, rotation: Floats, shift: Floats) -> Similarity:
    """Return the turn by a rotation vector (3,) about ``pivot`` (3,), and the ``shift`` (3,)."""
    matrix = Rotation.from_rotvec(rotation).as_matrix()
    return Similarity(1.0, matrix, pivot - matrix @ pivot + shift)


class HeadMotion:
    """The head between keys, before the first as there, after the last as there.

    Turns and shifts are interpolated by component. Without a key the head stays where it is.
    Raises :class:`InputError` (``scene.times``) for keys that are not one after the other.
    """

    def __init__(
        self, keys: Sequence[HeadKey], pivot: Floats, interpolation: Interpolation = "smooth"
    ) -> None:
        self._pivot = pivot
        values = [np.concatenate([key.rotation, key.shift]) for key in keys]
        self._track = track(
            [key.time for key in keys], np.reshape(values, (len(keys), 6)), "head", interpolation
        )

    def __call__(self, time: float) -> Similarity:
        """Return the motion into the world at ``time`` in s."""
        place = self._track(time)
        return turned(self._pivot, place[:3], place[3:])
