"""A warp that keeps landmarks and soft-tissue depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.warp import PlaneConstraints, Warp, least_bending, spread
from solver.surface import Floats

CENTRES = 600
STIFFNESS = 0.5
"""More misses landmarks by several mm, less folds space."""
STEPS = 14


@dataclass(frozen=True)
class Landmarks:
    """Corresponding points ``source`` and ``target``, (k, 3) in mm."""

    source: Floats
    target: Floats


@dataclass(frozen=True)
class Limits:
    """Least and greatest depth in mm, (n,) or one for all, of ``points`` (n, 3) under a skin."""

    points: Floats
    least: Floats | float
    greatest: Floats | float
    skin: SkinDepth

    def violated(self, warp: Warp) -> PlaneConstraints:
        """Return the displacements that bring the warped points back within their limits."""
        now = warp(self.points)
        depths, deeper = self.skin(now)
        missing = np.clip(depths, self.least, self.greatest) - depths
        wanted = missing + np.sum(deeper * (now - self.points), axis=1)
        active = missing != 0
        return PlaneConstraints(self.points[active], deeper[active], wanted[active])


def depth_warp(landmarks: Landmarks, limits: list[Limits]) -> Warp:
    """Return the least bending warp that meets landmarks and depth limits (Gauss-Newton).

    Each step linearises the depths of the points that violate their limits.
    """
    everything = np.vstack([landmarks.source, *[limit.points for limit in limits]])
    centres = everything[spread(everything, CENTRES)]
    fixed = PlaneConstraints(
        np.repeat(landmarks.source, 3, axis=0),
        np.tile(np.eye(3), (len(landmarks.source), 1)),
        (landmarks.target - landmarks.source).ravel(),
    )
    warp = Warp(centres, np.zeros((len(centres) + 4, 3)))
    for _ in range(STEPS):
        parts = [fixed, *[limit.violated(warp) for limit in limits]]
        planes = PlaneConstraints(
            np.vstack([part.points for part in parts]),
            np.vstack([part.directions for part in parts]),
            np.concatenate([part.distances for part in parts]),
        )
        warp = least_bending(centres, planes, STIFFNESS)
    return warp
