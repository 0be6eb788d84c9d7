"""Eyeballs, which no muscle of the face moves: they turn in the head by themselves."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from solver.model import SubjectModel
from solver.surface import Floats

SIDES = ("left", "right")


class Gaze:
    """Turns the eyeballs of a subject, the regions ``left_eyeball`` and ``right_eyeball``.

    A skin without them stays as it is.
    """

    def __init__(self, model: SubjectModel) -> None:
        skin = model.skin.vertices
        regions = [model.regions.get(f"{side}_eyeball", np.zeros(0, int)) for side in SIDES]
        self._balls = [(ids, _centre(skin[ids])) for ids in regions]

    def turn(self, skin: Floats, eyes: Floats) -> Floats:
        """Return a skin (V, 3) in the head's frame with eyes turned by vectors (2, 3) in rad."""
        turned = skin.copy()
        for (ids, centre), vector in zip(self._balls, eyes, strict=True):
            turned[ids] = centre + Rotation.from_rotvec(vector).apply(skin[ids] - centre)
        return turned


def _centre(points: Floats) -> Floats:
    """Return the centre (3,) of the sphere nearest to ``points`` (n, 3)."""
    system = np.column_stack([2.0 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(system, np.sum(points**2, axis=1), rcond=None)[0][:3])
