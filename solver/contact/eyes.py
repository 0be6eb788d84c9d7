"""Eyeballs, which lids lie on: spheres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats


@dataclass(frozen=True)
class Eyeball:
    """An :class:`solver.contact.one_sided.Obstacle`: ``centre`` (3,) and ``radius`` in mm."""

    centre: Floats
    radius: float

    @classmethod
    def of(cls, points: Floats) -> Eyeball:
        """Fit the sphere to the front half of an eyeball's vertices (k, 3), by least squares."""
        front = points[points[:, 2] >= np.median(points[:, 2])]
        middle = front.mean(axis=0)
        # |p - c|^2 = radius^2 is linear in c and radius^2 - |c|^2
        local = front - middle
        system = np.column_stack([2.0 * local, np.ones(len(local))])
        solution = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0]
        centre = solution[:3]
        return cls(middle + centre, float(np.sqrt(solution[3] + centre @ centre)))

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """See :class:`solver.contact.one_sided.Obstacle`: all of it counts everywhere."""
        arm = points - self.centre
        distance = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
        everywhere, nothing = np.ones(len(points)), np.zeros_like(points)
        return self.radius - distance, -arm / distance[:, None], everywhere, nothing
