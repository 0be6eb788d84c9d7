"""Skin that stays on the outer side of what is rigid: teeth and eyeballs.

    E(x) = 1/2 sum_v k_v max(0, h_v(x))^2

h_v is how far a skin vertex lies deeper than it may, by an obstacle that is given as a field: its
gradient leads out from any depth, so that nothing has to be known of how the vertex came there, and
none is ever pushed to the inner side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter, grey_closing

from solver.mechanics import jaw
from solver.mechanics.potential import Boundary, BoundaryRates
from solver.model import JawFrame
from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class OneSidedOptions:
    """Options of what keeps skin away: its margin, and its firmness."""

    margin_mm: float = 0.1  # kept free, unless it is less at rest: then that is
    stiffness_per_mm: float = 100.0  # stress that pushes out, over depth and the flesh's stiffness


class DepthField(Protocol):
    """A rigid thing, as a field in its own frame."""

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Measure points (k, 3).

        Returns depths (k,) in mm, negative outside, with their gradients (k, 3), and how much of
        them counts (k,), 0 beside the obstacle to 1, with its gradients (k, 3).
        """

    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the second derivatives (k, 3, 3) of depths and of how much counts."""


def free_depths(obstacle: DepthField, rest: Floats, least: float) -> Floats:
    """Return how deep (k,) in mm points may lie: as deep as they do in the neutral face.

    ``rest`` (k, 3) is where they are there, in the obstacle's frame. Less than ``least`` is free.
    """
    depth, _, counts, _ = obstacle.depths(rest)
    return np.where(counts > 0.0, np.maximum(depth, least), least)


class Excess:
    """Depths of points by an obstacle beyond what is ``free`` (k,), all in its frame."""

    def __init__(self, obstacle: DepthField, free: Floats) -> None:
        self._obstacle = obstacle
        self._free = free

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return h (k,), zero where nothing pushes, and its gradients (k, 3)."""
        depth, out, counts, fades = self._obstacle.depths(points)
        excess = np.maximum(depth - self._free, 0.0)
        slope = counts[:, None] * out + excess[:, None] * fades
        slope[excess == 0.0] = 0.0
        return counts * excess, slope

    def curvature_at(self, points: Floats) -> Floats:
        """Return the second derivatives (k, 3, 3) of h, zero where nothing pushes."""
        depth, out, counts, fades = self._obstacle.depths(points)
        excess = np.maximum(depth - self._free, 0.0)
        by_depth, by_counts = self._obstacle.curvatures(points)
        mixed = out[:, :, None] * fades[:, None, :]
        second = counts[:, None, None] * by_depth + excess[:, None, None] * by_counts
        second += mixed + mixed.transpose(0, 2, 1)
        second[excess == 0.0] = 0.0
        return np.asarray(second)

    def behind(self, points: Floats, tolerance: float) -> Ints:
        """Return which lie deeper by ``tolerance`` than they may, well over the field."""
        depth, _, counts, _ = self._obstacle.depths(points)
        return np.flatnonzero((depth - np.maximum(self._free, 0.0) > tolerance) & (counts > 0.5))


class OneSided:
    """A :class:`solver.mechanics.potential.Potential` of skin vertices and one obstacle.

    Parameters
    ----------
    obstacle
        Where it is at rest.
    rows, offset
        (k, p) CSR and (k, 3): the vertices are ``rows @ x + offset``.
    free
        (k,) how deep they may lie, mm: :func:`free_depths`.
    stiffness
        (k,) per vertex, energy over mm^2.
    carried
        The frame of the jaw that the obstacle moves with; None for what stays with the head.
    """

    def __init__(
        self,
        obstacle: DepthField,
        rows: sp.csr_array,
        offset: Floats,
        free: Floats,
        stiffness: Floats,
        carried: JawFrame | None = None,
    ) -> None:
        self.obstacle = obstacle
        self._excess = Excess(obstacle, free)
        self._rows = rows
        self._offset = offset
        self._stiffness = stiffness
        self._carried = carried
        self._jaw = np.zeros(jaw.DEGREES_OF_FREEDOM)
        self._last: tuple[Floats, tuple[Floats, Floats]] | None = None

    def begin(self, x: Floats, now: Boundary, seconds: float) -> None:  # noqa: ARG002 - nothing lags
        """See :class:`solver.mechanics.potential.Potential`."""
        self.place(now)

    def place(self, boundary: Boundary) -> None:
        """See :class:`solver.mechanics.potential.Potential`."""
        self._jaw = boundary.jaw
        self._last = None

    def value(self, x: Floats) -> float:
        """See :class:`solver.mechanics.potential.Potential`."""
        h, _ = self._depths(x)
        return 0.5 * float(self._stiffness @ h**2)

    def gradient(self, x: Floats) -> Floats:
        """See :class:`solver.mechanics.potential.Potential`."""
        h, slope = self._depths(x)
        return np.asarray(self._rows.T @ ((self._stiffness * h)[:, None] * slope))

    def hessian(self, x: Floats) -> sp.csr_array:
        """See :class:`solver.mechanics.potential.Potential`: by Gauss and Newton."""
        h, slope = self._depths(x)
        deep = np.flatnonzero(h)
        by_x = along(sp.csr_array(self._rows[deep]), slope[deep])
        return sp.csr_array(by_x.T @ (sp.diags_array(self._stiffness[deep]) @ by_x))

    def curvature(self, x: Floats) -> sp.csr_array:
        """See :class:`solver.mechanics.potential.Potential`."""
        deep, blocks = self._second(x)
        if not len(deep):
            return sp.csr_array((x.size, x.size))
        rows = sp.kron(self._rows[deep], sp.eye_array(3), format="csr")
        places = np.arange(len(deep) + 1)
        return sp.csr_array(rows.T @ (sp.bsr_array((blocks, places[:-1], places)) @ rows))

    def by_boundary(self, x: Floats, rates: BoundaryRates) -> Floats:
        """See :class:`solver.mechanics.potential.Potential`."""
        out = np.zeros((*x.shape, rates.count))
        deep, blocks = self._second(x)
        if self._carried is None or not len(deep):
            return out
        h, slope = self._depths(x)
        # the obstacle moves under the vertex by the jaw's motion there, and its directions turn
        frame = self._carried
        moved = jaw.jacobian(frame, self._seen_at(x)[deep], self._jaw)
        turned = jaw.jacobian(frame, frame.origin + slope[deep] @ self._turn, self._jaw)
        turned[:, :, 2:] = 0.0
        by_jaw = (self._stiffness * h)[deep, None, None] * turned
        by_jaw -= np.einsum("kij,kjb->kib", blocks, moved)
        on_points = (by_jaw @ rates.jaw).reshape(len(deep), -1)
        out += (self._rows[deep].T @ on_points).reshape(out.shape)
        return out

    def pull(self, x: Floats, goal: Boundary) -> Floats:
        """See :class:`solver.mechanics.potential.Potential`."""
        if self._carried is None:
            return np.zeros_like(x)
        _, slope = self._depths(x)
        points = self._points(x)
        # the vertex's motion as seen from the jaw, in the head's directions
        seen = self._seen(points, goal.jaw) - self._seen(points, self._jaw)
        nearer = np.einsum("ki,ki->k", slope, seen @ self._turn.T)
        return np.asarray(self._rows.T @ ((self._stiffness * nearer)[:, None] * slope))

    def longest(self, x: Floats, y: Floats, goal: Boundary) -> float:  # noqa: ARG002 - no bounds
        """See :class:`solver.mechanics.potential.Potential`."""
        return 1.0

    def behind(self, x: Floats, b: Floats, tolerance: float) -> Ints:
        """Return the vertices deeper by ``tolerance`` than they may, the jaw being at b (5,)."""
        return self._excess.behind(self._seen(self._points(x), b), tolerance)

    def _depths(self, x: Floats) -> tuple[Floats, Floats]:
        """Return h (k,), zero where nothing pushes, and the head's frame's gradients (k, 3)."""
        # value, gradient and Hessian ask for the same x again
        if self._last is None or not np.array_equal(self._last[0], x):
            h, slope = self._excess.at(self._seen_at(x))
            self._last = x.copy(), (h, slope @ self._turn.T)
        return self._last[1]

    def _second(self, x: Floats) -> tuple[Ints, Floats]:
        """Return the vertices (d,) that are pushed, and d2E by their positions (d, 3, 3)."""
        h, slope = self._depths(x)
        deep = np.flatnonzero(h)
        second = self._excess.curvature_at(self._seen_at(x))[deep]
        second = np.einsum("ip,kpq,jq->kij", self._turn, second, self._turn)
        outer = slope[deep, :, None] * slope[deep, None, :]
        stiffness = self._stiffness[deep, None, None]
        return deep, stiffness * (outer + h[deep, None, None] * second)

    def _seen_at(self, x: Floats) -> Floats:
        return self._seen(self._points(x), self._jaw)

    def _points(self, x: Floats) -> Floats:
        return np.asarray(self._rows @ x + self._offset)

    def _seen(self, points: Floats, b: Floats) -> Floats:
        """Return points (k, 3) of the head in the obstacle's frame, with the jaw at b (5,)."""
        return points if self._carried is None else jaw.move_back(self._carried, points, b)

    @property
    def _turn(self) -> Floats:
        """Return the rotation (3, 3) from the obstacle's frame into the head's."""
        return np.eye(3) if self._carried is None else jaw.rotation(self._carried, self._jaw)


def along(rows: sp.csr_array, directions: Floats) -> sp.csr_array:
    """Return by what x (p, 3) moves points ``rows @ x`` along directions (k, 3): (k, 3 p)."""
    entries = sp.coo_array(rows)
    row, column = entries.coords
    values = entries.data[:, None] * directions[row]
    columns = 3 * column[:, None] + np.arange(3)
    return sp.csr_array(
        (values.ravel(), (np.repeat(row, 3), columns.ravel())),
        shape=(rows.shape[0], 3 * rows.shape[1]),
    )


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
class Arch:
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
        degrees, mm, around = options.step_degrees, options.step_mm, options.around_mm
        points = _samples(teeth, options.sample_mm)
        low, high = points.min(axis=0), points.max(axis=0)
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

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """See :class:`DepthField`."""
        place = _Cylindrical.of(points - self.axis, self.options.step_mm)
        reach, slope = place.value(self.radius), place.gradient(self.radius)
        border = place.gradient(self.inside)
        part, fade_mm = self._part(place), self.options.fade_mm
        counts = part**2 * (3.0 - 2.0 * part)
        fades = (6.0 * part * (1.0 - part) / fade_mm)[:, None] * border
        return reach - place.radius, slope - place.outward, counts, fades

    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        """See :class:`DepthField`."""
        place = _Cylindrical.of(points - self.axis, self.options.step_mm)
        around, radius = place.around, place.radius
        by_depth = place.curvature(self.radius)
        by_depth -= around[:, :, None] * around[:, None, :] / radius[:, None, None]
        border, bending = place.gradient(self.inside), place.curvature(self.inside)
        part, fade_mm = self._part(place), self.options.fade_mm
        steep, bent = 6.0 * part * (1.0 - part) / fade_mm, 6.0 * (1.0 - 2.0 * part) / fade_mm**2
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
class Eyeball:
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

    def depths(self, points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """See :class:`DepthField`: all of it counts everywhere."""
        distance, out = self._from_centre(points)
        return self.radius - distance, -out, np.ones(len(points)), np.zeros_like(points)

    def curvatures(self, points: Floats) -> tuple[Floats, Floats]:
        """See :class:`DepthField`."""
        distance, out = self._from_centre(points)
        tangent = np.eye(3) - out[:, :, None] * out[:, None, :]
        return -tangent / distance[:, None, None], np.zeros_like(tangent)

    def _from_centre(self, points: Floats) -> tuple[Floats, Floats]:
        arm = points - self.centre
        distance = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
        return distance, arm / distance[:, None]


def nearest_sphere(points: Floats) -> tuple[Floats, float]:
    """Return centre (3,) and radius of the sphere nearest to points (k, 3), by least squares."""
    # |p - c|^2 = radius^2 is linear in c and radius^2 - |c|^2
    system = np.column_stack([2.0 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    return centre, float(np.sqrt(solution[3] + centre @ centre))
