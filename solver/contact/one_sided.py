"""Skin that stays on the outer side of what is rigid: teeth and eyeballs.

    E(x) = 1/2 sum_v k_v max(0, h_v(x))^2

h_v is how far a skin vertex lies deeper than it may in one of the
:mod:`solver.contact.obstacles`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.contact.obstacles import DepthField
from solver.mechanics.boundary import (
    JAW_FREEDOM,
    Boundary,
    BoundaryRates,
    Potential,
    jaw_jacobian,
    jaw_rotation,
    move_jaw_back,
)
from solver.model import JawFrame
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class OneSidedOptions:
    """Options of what keeps skin away: its margin, and its firmness."""

    margin_mm: float = 0.1  # kept free, unless it is less at rest: then that is
    stiffness_per_mm: float = 100.0  # stress that pushes out, over depth and the flesh's stiffness


ONE_SIDED = OneSidedOptions()


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


class OneSided(Potential):
    """The potential of skin vertices and one obstacle.

    The vertices ``rows @ x + offset``, (k, p) CSR and (k, 3), may lie in the ``obstacle``, which is
    where it is at rest, ``free`` mm deep (k,): :func:`free_depths`. ``stiffness`` (k,) is energy
    over mm^2. An obstacle ``carried`` moves with the jaw of that frame, others stay with the head.
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
        self._jaw = np.zeros(JAW_FREEDOM)
        self._last: tuple[Floats, tuple[Floats, Floats]] | None = None

    @override
    def begin(self, x: Floats, now: Boundary, seconds: float) -> None:
        self.place(now)

    @override
    def place(self, boundary: Boundary) -> None:
        self._jaw = boundary.jaw
        self._last = None

    @override
    def value(self, x: Floats) -> float:
        h, _ = self._depths(x)
        return 0.5 * float(self._stiffness @ h**2)

    @override
    def gradient(self, x: Floats) -> Floats:
        h, slope = self._depths(x)
        return np.asarray(self._rows.T @ ((self._stiffness * h)[:, None] * slope))

    @override
    def hessian(self, x: Floats) -> sp.csr_array:
        """Return the second derivative by Gauss and Newton."""
        h, slope = self._depths(x)
        deep = np.flatnonzero(h)
        by_x = along(sp.csr_array(self._rows[deep]), slope[deep])
        return sp.csr_array(by_x.T @ (sp.diags_array(self._stiffness[deep]) @ by_x))

    @override
    def curvature(self, x: Floats) -> sp.csr_array:
        deep, blocks = self._second(x)
        if not len(deep):
            return sp.csr_array((x.size, x.size))
        rows = sp.kron(self._rows[deep], sp.eye_array(3), format="csr")
        places = np.arange(len(deep) + 1)
        return sp.csr_array(rows.T @ (sp.bsr_array((blocks, places[:-1], places)) @ rows))

    @override
    def by_boundary(self, x: Floats, rates: BoundaryRates) -> Floats:
        out = np.zeros((*x.shape, rates.count))
        deep, blocks = self._second(x)
        if self._carried is None or not len(deep):
            return out
        h, slope = self._depths(x)
        # the obstacle moves under the vertex by the jaw's motion there, and its directions turn
        frame = self._carried
        moved = jaw_jacobian(frame, self._seen_at(x)[deep], self._jaw)
        turned = jaw_jacobian(frame, frame.origin + slope[deep] @ self._turn, self._jaw)
        turned[:, :, 2:] = 0.0
        by_jaw = (self._stiffness * h)[deep, None, None] * turned
        by_jaw -= np.einsum("kij,kjb->kib", blocks, moved)
        on_points = (by_jaw @ rates.jaw).reshape(len(deep), -1)
        out += (self._rows[deep].T @ on_points).reshape(out.shape)
        return out

    @override
    def pull(self, x: Floats, goal: Boundary) -> Floats:
        if self._carried is None:
            return np.zeros_like(x)
        _, slope = self._depths(x)
        points = self._points(x)
        # the vertex's motion as seen from the jaw, in the head's directions
        seen = self._seen(points, goal.jaw) - self._seen(points, self._jaw)
        nearer = np.einsum("ki,ki->k", slope, seen @ self._turn.T)
        return np.asarray(self._rows.T @ ((self._stiffness * nearer)[:, None] * slope))

    @override
    def max_step(self, x: Floats, y: Floats, goal: Boundary) -> float:
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
        return points if self._carried is None else move_jaw_back(self._carried, points, b)

    @property
    def _turn(self) -> Floats:
        """Return the rotation (3, 3) from the obstacle's frame into the head's."""
        return np.eye(3) if self._carried is None else jaw_rotation(self._carried, self._jaw)


def along(rows: sp.csr_array, directions: Floats) -> sp.csr_array:
    """Return by what x (p, 3) moves points ``rows @ x`` along directions (k, 3): (k, 3 p)."""
    entries = sp.coo_array(rows)
    row, column = entries.coords
    values = entries.data[:, None] * directions[row]
    places = np.repeat(row, 3), (3 * column[:, None] + np.arange(3)).ravel()
    return sp.csr_array((values.ravel(), places), shape=(rows.shape[0], 3 * rows.shape[1]))
