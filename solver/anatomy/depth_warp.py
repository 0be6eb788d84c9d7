"""A symmetric warp that keeps landmarks and soft-tissue depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.warp import PlaneConstraints, Warp, least_bending, spread
from solver.surface import Floats

STEPS = 14


MIRROR = np.array([-1.0, 1.0, 1.0])


def both_sides(points: Floats) -> Floats:
    """Return points (n, 3) and their mirror images, (2 n, 3)."""
    return np.vstack([points, points * MIRROR])


@dataclass(frozen=True)
class Landmarks:
    """Corresponding points ``source`` and ``target``, (k, 3) in mm, of the left and the middle."""

    source: Floats
    target: Floats


@dataclass(frozen=True)
class Limits:
    """Least and greatest depth in mm, (n,) or one for all, of ``points`` (n, 3) under a skin.

    The points are those of the left and the middle.
    """

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


def depth_warp(
    landmarks: Landmarks, limits: list[Limits], *, centres: int, stiffness: float
) -> Warp:
    """Return the least bending warp that meets landmarks and depth limits (Gauss-Newton).

    Each step linearises the depths of the points that violate their limits. What is given for the
    left also holds for the right, mirrored at x = 0: the warp is symmetric. It has ``centres`` on
    the left and as many on the right; more ``stiffness`` misses what is wanted by more, less folds
    space.
    """
    everything = np.vstack([landmarks.source, *[limit.points for limit in limits]])
    kernels = both_sides(everything[spread(everything, centres)])
    fixed = PlaneConstraints(
        np.repeat(landmarks.source, 3, axis=0),
        np.tile(np.eye(3), (len(landmarks.source), 1)),
        (landmarks.target - landmarks.source).ravel(),
    )
    warp = Warp(kernels, np.zeros((len(kernels) + 4, 3)))
    for _ in range(STEPS):
        parts = [fixed, *[limit.violated(warp) for limit in limits]]
        planes = PlaneConstraints(
            both_sides(np.vstack([part.points for part in parts])),
            both_sides(np.vstack([part.directions for part in parts])),
            np.tile(np.concatenate([part.distances for part in parts]), 2),
        )
        warp = least_bending(kernels, planes, stiffness)
    return warp
