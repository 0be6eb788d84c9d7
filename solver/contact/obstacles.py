"""Rigid things that skin stays outside of, as fields: rows of teeth and eyeballs.

A field's gradient leads out from any depth, so that nothing has to be known of how a point came
there, and none is ever pushed to the inner side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter, grey_closing
from typing_extensions import override

from solver.surface import Floats, Surface, nearest_sphere


class DepthField(Protocol):
    """A rigid thing, as a field in its own frame."""

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Measure points (k, 3).

        Returns depths (k,) in mm, negative outside, with their gradients (k, 3), and how much of
        them counts (k,), 0 beside the obstacle to 1, with its gradients (k, 3).
        """

    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the second derivatives (k, 3, 3) of depths and of how much counts."""


@dataclass(frozen=True)
class ArchOptions:
    """Options of the table of a row of teeth."""

    axis_mm: float = 10.0  # the axis stands so far before the hindmost teeth
    step_degrees: float = 1.0  # of the table
    step_mm: float = 0.5
    gap_degrees: float = 9.0  # gaps between teeth up to this size are closed
    gap_mm: float = 1.5
    fade_mm: float = 1.0  # within this from its border the field fades
    sample_mm: float = 0.25  # between points of the teeth's surface
    around_mm: float = 2.0  # tabulated beyond the teeth, where nothing of it counts


@dataclass(frozen=True)
class Arch(DepthField):
    """A :class:`DepthField`: how far out a row of teeth reaches, all around.

        r = R(theta, y)

    in cylindrical coordinates around a vertical axis through the arch's middle is the largest
    radius of the teeth's surface, the gaps between crowns closed. A lip's vertex lies R - r deep:
    behind teeth, however far, it is led out to the front. ``axis`` (3,) is a point on the axis;
    ``radius`` and ``inside``, by angle in rad and height in mm, are R and how far a place lies
    inside the border of the field, both in mm.
    """

    axis: Floats
    radius: RectBivariateSpline
    inside: RectBivariateSpline
    options: ArchOptions = ArchOptions()

    @classmethod
    def of(cls, teeth: Surface, options: ArchOptions = ArchOptions()) -> Arch:
        """Tabulate the field of a row of teeth, whose front looks along z."""
        degrees = options.step_degrees
        mm = options.step_mm
        around = options.around_mm
        points = _samples(teeth, options.sample_mm)
        low = points.min(axis=0)
        high = points.max(axis=0)
        axis = (low + high) / 2
        axis[2] = low[2] + options.axis_mm
        arms = _Cylindrical.of(points - axis, 0.0)
        angles = np.arange(-180.0, 180.0, degrees)
        heights = np.arange(low[1] - around, high[1] + around, mm) - axis[1]
        row = np.round((np.degrees(arms.angle) + 180.0) / degrees).astype(int) % len(angles)
        column = np.round((arms.height - heights[0]) / mm).astype(int)
        table = np.zeros((len(angles), len(heights)))
        np.maximum.at(table, (row, column), arms.radius)
        # the seam lies behind, where there are no teeth
        gap = round(options.gap_degrees / degrees), round(options.gap_mm / mm)
        table = grey_closing(table, gap)
        covered = table > 0.0
        nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
        table = gaussian_filter(table[tuple(nearest)], 1.0)
        cell = (np.radians(degrees) * arms.radius.mean(), mm)
        inside = distance_transform_edt(covered, cell) - distance_transform_edt(~covered, cell)
        grid = (np.radians(angles), heights)
        border = RectBivariateSpline(*grid, gaussian_filter(inside, 1.0))
        return cls(axis, RectBivariateSpline(*grid, table), border, options)

    @override
    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        place = _Cylindrical.of(points - self.axis, self.options.step_mm)
        reach = place.value(self.radius)
        slope = place.gradient(self.radius)
        border = place.gradient(self.inside)
        part = self._part(place)
        fade_mm = self.options.fade_mm
        counts = part**2 * (3.0 - 2.0 * part)
        fades = (6.0 * part * (1.0 - part) / fade_mm)[:, None] * border
        return reach - place.radius, slope - place.outward, counts, fades

    @override
    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        place = _Cylindrical.of(points - self.axis, self.options.step_mm)
        around = place.around
        radius = place.radius
        by_depth = place.curvature(self.radius)
        by_depth -= around[:, :, None] * around[:, None, :] / radius[:, None, None]
        border = place.gradient(self.inside)
        bending = place.curvature(self.inside)
        part = self._part(place)
        fade_mm = self.options.fade_mm
        steep = 6.0 * part * (1.0 - part) / fade_mm
        bent = 6.0 * (1.0 - 2.0 * part) / fade_mm**2
        bent[(part == 0.0) | (part == 1.0)] = 0.0
        by_counts = bent[:, None, None] * border[:, :, None] * border[:, None, :]
        return by_depth, by_counts + steep[:, None, None] * bending

    def _part(self, place: _Cylindrical) -> Floats:
        """Return how far (k,) places are from the border of the field, 0, to where all counts."""
        return np.clip(place.value(self.inside) / self.options.fade_mm, 0.0, 1.0)


UP = np.array([0.0, 1.0, 0.0])  # the direction of an arch's axis


@dataclass(frozen=True)
class _Cylindrical:
    """Arms (k, 3) from an axis as angles from z to x in rad, heights and radii (k,) in mm.

    ``outward`` and ``around`` (k, 3) are the unit directions in which radius and angle grow.
    """

    angle: Floats
    height: Floats
    radius: Floats
    outward: Floats
    around: Floats

    @classmethod
    def of(cls, arm: Floats, least: float) -> _Cylindrical:
        """Return arms of at least so small a radius."""
        radius = np.maximum(np.hypot(arm[:, 0], arm[:, 2]), least)
        outward = arm * [1.0, 0.0, 1.0] / radius[:, None]
        around = outward[:, ::-1] * [1.0, 0.0, -1.0]
        return cls(np.arctan2(arm[:, 0], arm[:, 2]), arm[:, 1], radius, outward, around)

    def value(self, spline: RectBivariateSpline, dx: int = 0, dy: int = 0) -> Floats:
        """Return a field (k,) of angle and height, or its derivative by them."""
        return np.asarray(spline.ev(self.angle, self.height, dx=dx, dy=dy))

    def gradient(self, spline: RectBivariateSpline) -> Floats:
        """Return its derivative by the places, (k, 3)."""
        by_angle = self.around / self.radius[:, None]
        along = self.value(spline, dy=1)[:, None] * UP
        return np.asarray(self.value(spline, dx=1)[:, None] * by_angle + along)

    def curvature(self, spline: RectBivariateSpline) -> Floats:
        """Return its second derivative by the places, (k, 3, 3)."""
        by_angle = self.around / self.radius[:, None]
        # d2(angle): the direction around turns with the angle and shrinks with the radius
        turning = self.around[:, :, None] * self.outward[:, None, :]
        turning += turning.transpose(0, 2, 1)
        mixed = self.value(spline, 1, 1)[:, None, None] * by_angle[:, :, None] * UP
        second = self.value(spline, 2)[:, None, None] * by_angle[:, :, None] * by_angle[:, None, :]
        second += mixed + mixed.transpose(0, 2, 1)
        second += self.value(spline, 0, 2)[:, None, None] * np.outer(UP, UP)
        bending = self.value(spline, 1) / self.radius**2
        return np.asarray(second - bending[:, None, None] * turning)


def _samples(surface: Surface, apart: float) -> Floats:
    """Return points all over the triangles, no more than so many mm apart."""
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.maximum(np.ceil(longest / apart).astype(int), 1)
    found = []
    for count in np.unique(counts):
        first, second = np.triu_indices(count + 1)
        shares = np.stack([first, second - first, count - second], axis=1) / count
        points = np.einsum("kc,fci->kfi", shares, corners[counts == count])
        found.append(points.reshape(-1, 3))
    return np.vstack(found)


@dataclass(frozen=True)
class Eyeball(DepthField):
    """A :class:`DepthField` of what lids lie on: ``centre`` (3,) and ``radius`` in mm."""

    centre: Floats
    radius: float

    @classmethod
    def of(cls, points: Floats) -> Eyeball:
        """Fit the sphere to the front half of an eyeball's vertices (k, 3), by least squares."""
        front = points[points[:, 2] >= np.median(points[:, 2])]
        middle = front.mean(axis=0)
        centre, radius = nearest_sphere(front - middle)
        return cls(middle + centre, radius)

    @override
    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Measure points, all of which count everywhere."""
        distance, out = self._from_centre(points)
        return self.radius - distance, -out, np.ones(len(points)), np.zeros_like(points)

    @override
    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        distance, out = self._from_centre(points)
        tangent = np.eye(3) - out[:, :, None] * out[:, None, :]
        return -tangent / distance[:, None, None], np.zeros_like(tangent)

    def _from_centre(self, points: Floats) -> tuple[Floats, Floats]:
        arm = points - self.centre
        distance = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
        return distance, arm / distance[:, None]
