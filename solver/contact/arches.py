"""Rows of teeth as lips see them: how far out the teeth reach, all around.

    r = R(theta, y)

in cylindrical coordinates around a vertical axis through the arch's middle: the largest radius of
the teeth's surface, the gaps between crowns closed. A lip's vertex lies R - r deep. So a lip that
is behind teeth, however far, is led out to the front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter, grey_closing

from solver.surface import Floats, Surface

AXIS_MM = 10.0
"""The axis stands so far before the hindmost teeth."""
STEP_DEGREES, STEP_MM = 1.0, 0.5
GAP_DEGREES, GAP_MM = 9.0, 1.5
"""Gaps between teeth up to this size are closed."""
FADE_MM = 1.0
"""Within this from its border the field fades."""
SAMPLE_MM = 0.25
AROUND_MM = 2.0
"""The field is tabulated this far beyond the teeth, where nothing of it counts."""


@dataclass(frozen=True)
class Arch:
    """An :class:`solver.contact.one_sided.Obstacle`: the outer side of a row of teeth.

    ``axis`` (3,) is a point on the vertical axis; ``radius`` and ``inside``, by angle in rad and
    height in mm, are R and how far a place lies inside the border of the field, both in mm.
    """

    axis: Floats
    radius: RectBivariateSpline
    inside: RectBivariateSpline

    @classmethod
    def of(cls, teeth: Surface) -> Arch:
        """Tabulate the field of a row of teeth, whose front looks along z."""
        points = _samples(teeth)
        low, high = points.min(axis=0), points.max(axis=0)
        axis = (low + high) / 2
        axis[2] = low[2] + AXIS_MM
        angle, height, radius = _cylindrical(points - axis)
        angles = np.arange(-180.0, 180.0, STEP_DEGREES)
        heights = np.arange(low[1] - AROUND_MM, high[1] + AROUND_MM, STEP_MM) - axis[1]
        place = (
            np.round((np.degrees(angle) + 180.0) / STEP_DEGREES).astype(int) % len(angles),
            np.round((height - heights[0]) / STEP_MM).astype(int),
        )
        table = np.zeros((len(angles), len(heights)))
        np.maximum.at(table, place, radius)
        # the seam lies behind, where there are no teeth
        gap = (round(GAP_DEGREES / STEP_DEGREES), round(GAP_MM / STEP_MM))
        table = grey_closing(table, gap)
        covered = table > 0.0
        nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
        table = gaussian_filter(table[tuple(nearest)], 1.0)
        cell = (np.radians(STEP_DEGREES) * radius.mean(), STEP_MM)
        inside = distance_transform_edt(covered, cell) - distance_transform_edt(~covered, cell)
        grid = (np.radians(angles), heights)
        return cls(
            axis,
            RectBivariateSpline(*grid, table),
            RectBivariateSpline(*grid, gaussian_filter(inside, 1.0)),
        )

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """See :class:`solver.contact.one_sided.Obstacle`."""
        arm = points - self.axis
        angle, height, radius = _cylindrical(arm)
        radius = np.maximum(radius, STEP_MM)
        around = np.stack([arm[:, 2], np.zeros(len(arm)), -arm[:, 0]], axis=1)
        around /= (radius**2)[:, None]
        up = np.array([0.0, 1.0, 0.0])
        outward = arm * [1.0, 0.0, 1.0] / radius[:, None]

        def field(spline: RectBivariateSpline) -> tuple[Floats, Floats]:
            by_angle = np.asarray(spline.ev(angle, height, dx=1))
            by_height = np.asarray(spline.ev(angle, height, dy=1))
            gradient = by_angle[:, None] * around + by_height[:, None] * up
            return np.asarray(spline.ev(angle, height)), gradient

        reach, slope = field(self.radius)
        inside, border = field(self.inside)
        part = np.clip(inside / FADE_MM, 0.0, 1.0)
        counts = part**2 * (3.0 - 2.0 * part)
        fades = (6.0 * part * (1.0 - part) / FADE_MM)[:, None] * border
        return reach - radius, slope - outward, counts, fades


def _cylindrical(arm: Floats) -> tuple[Floats, Floats, Floats]:
    """Return angles from z to x in rad, heights and radii (k,) of arms (k, 3) from the axis."""
    return np.arctan2(arm[:, 0], arm[:, 2]), arm[:, 1], np.hypot(arm[:, 0], arm[:, 2])


def _samples(surface: Surface) -> Floats:
    """Return points all over the triangles, no more than :data:`SAMPLE_MM` apart."""
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.maximum(np.ceil(longest / SAMPLE_MM).astype(int), 1)
    found = []
    for count in np.unique(counts):
        first, second = np.triu_indices(count + 1)
        shares = np.stack([first, second - first, count - second], axis=1) / count
        points = np.einsum("kc,fci->kfi", shares, corners[counts == count])
        found.append(points.reshape(-1, 3))
    return np.vstack(found)
