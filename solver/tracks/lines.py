"""Centre lines of muscles: the middles of a muscle's slices, from its origin to its insertion.

Slices are level sets of the potential u along the fibres d,

    min_u  1/2 int sigma |grad u - d|^2

with sigma a muscle's volume fraction: u is the way along the muscle in mm. Fibres around a ring are
no gradient; there u is the angle around its middle, and the line is closed. A point of a line is
the mean place of the flesh of its slice, so its target is that of the target volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.model import SubjectModel
from solver.surface import Floats, Ints, own_numbers


@dataclass(frozen=True)
class LineOptions:
    """Fineness of centre lines, and what has one."""

    step_mm: float = 8.0  # between points
    most_points: int = 12  # of a line, and of a ring
    # quantiles of the flesh along a muscle between which its line is: what tapers off counts little
    ends: tuple[float, float] = (0.05, 0.95)
    shortest_mm: float = 2.0  # a muscle with less between its ends has no line
    # part of |d|^2 that no gradient explains above which fibres go round a ring
    ring: float = 0.5
    pull: float = 1e-6  # weight of the mean direction, for pieces of flesh that do not touch


@dataclass(frozen=True)
class CentreLines:
    """Centre lines of m muscles; a muscle without flesh or fibres has none.

    Points of all lines in turn are ``rows`` (c, p) @ vertices, those of muscle j from ``first[j]``
    to before ``first[j + 1]``.
    """

    rows: sp.csr_array  # (c, p), each row a mean of vertices
    first: Ints  # (m + 1,)
    closed: np.ndarray  # (m,) bool

    @classmethod
    def of(cls, model: SubjectModel, options: LineOptions = LineOptions()) -> CentreLines:
        """Draw the centre lines of a model's muscles."""
        gradients, volumes = shape_gradients(model.rest, model.tets)
        entries = model.weights.tocoo()
        count = model.muscle_count
        parts = [sp.csr_array((0, len(model.rest)))]
        first = [0]
        closed = np.zeros(count, dtype=bool)
        for number in range(count):
            own = np.flatnonzero((entries.col == number + 1) & (entries.data > 0.0))
            found = None
            if len(own) and model.fibres is not None:
                rows = entries.row[own]
                volume = volumes[rows] * entries.data[own]
                flesh = _Flesh.of(model, rows, gradients[rows], volume, model.fibres[own])
                closed[number], found = flesh.slices(options)
            if found is not None:
                parts.append(_middles(found, model.tets[rows], volume, len(model.rest)))
            first.append(first[-1] + (0 if found is None else found.shape[1]))
        return cls(sp.csr_array(sp.vstack(parts, format="csr")), np.array(first), closed)

    @property
    def segments(self) -> tuple[Ints, Ints, Ints]:
        """Return muscle, first and second point (s,) of every segment."""
        muscle = []
        start = []
        end = []
        for number, closed in enumerate(self.closed):
            points = np.arange(self.first[number], self.first[number + 1])
            following = np.roll(points, -1)
            if not closed:
                points = points[:-1]
                following = following[:-1]
            muscle.append(np.full(len(points), number))
            start.append(points)
            end.append(following)
        return np.concatenate(muscle), np.concatenate(start), np.concatenate(end)

    def points(self, x: Floats) -> Floats:
        """Return the lines' points (c, 3) in flesh at x (p, 3)."""
        return np.asarray(self.rows @ x)

    def lengths(self, x: Floats) -> Floats:
        """Return the lines' lengths (m,) mm, zero where there is no line."""
        muscle, start, end = self.segments
        points = self.points(x)
        each = np.linalg.norm(points[end] - points[start], axis=1)
        return np.asarray(np.bincount(muscle, each, len(self.closed)), np.float64)

    def length_rates(self, x: Floats, motion: Floats) -> Floats:
        """Return the lengths' derivatives (m, k) as the flesh moves by ``motion`` (p, 3, k)."""
        muscle, start, end = self.segments
        points = self.points(x)
        way = points[end] - points[start]
        along = way / np.linalg.norm(way, axis=1, keepdims=True)
        moved = self.rows @ motion.reshape(len(motion), -1)
        moved = moved.reshape(len(points), 3, -1)
        each = np.einsum("si,sik->sk", along, moved[end] - moved[start])
        out = np.zeros((len(self.closed), motion.shape[2]))
        np.add.at(out, muscle, each)
        return out


@dataclass(frozen=True)
class _Flesh:
    """The tets of one muscle: their own vertices and numbers, and the fibres in them."""

    points: Floats  # (q, 3)
    tets: Ints  # (t, 4)
    gradients: Floats  # (t, 4, 3)
    volume: Floats  # (t,) of the muscle
    fibres: Floats  # (t, 3)

    @classmethod
    def of(
        cls, model: SubjectModel, rows: Ints, gradients: Floats, volume: Floats, fibres: Floats
    ) -> _Flesh:
        numbers, tets = own_numbers(model.tets[rows])
        return cls(model.rest[numbers], tets, gradients, volume, fibres)

    def slices(self, options: LineOptions) -> tuple[bool, sp.csr_array | None]:
        """Return whether the line is closed, and each tet's parts (t, c) in its slices.

        Without a line there are none.
        """
        way, misfit = self._way(options.pull)
        if misfit > options.ring:
            return True, self._around(options)
        order = np.argsort(way)
        filled = np.cumsum(self.volume[order]) / self.volume.sum()
        low, high = np.interp(options.ends, filled, way[order])
        if high - low < options.shortest_mm:
            return False, None
        count = int(np.clip(round((high - low) / options.step_mm), 1, options.most_points - 1)) + 1
        place = np.clip((way - low) / (high - low), 0.0, 1.0) * (count - 1)
        return False, _between(place, count)

    def _way(self, pull: float) -> tuple[Floats, float]:
        """Return u (t,) in the middle of each tet, and what part of the fibres it leaves."""
        count = len(self.points)
        matrix = laplacian(self.gradients, self.volume, self.tets, count)
        held = pull * matrix.diagonal().mean()
        mean = self.volume @ self.fibres / self.volume.sum()
        sources = self.volume[:, None] * np.einsum("tid,td->ti", self.gradients, self.fibres)
        load = np.zeros(count)
        np.add.at(load, self.tets, sources)
        load += held * (self.points - self.points.mean(axis=0)) @ mean
        u = HarmonicExtension(matrix + held * sp.eye_array(count))(load=load)
        slope = np.einsum("ti,tid->td", u[self.tets], self.gradients)
        left = self.volume @ ((slope - self.fibres) ** 2).sum(axis=1)
        return u[self.tets].mean(axis=1), float(left / self.volume.sum())

    def _around(self, options: LineOptions) -> sp.csr_array:
        """Return each tet's parts in slices by the angle around the ring's middle."""
        middles = self.points[self.tets].mean(axis=1)
        centre = self.volume @ middles / self.volume.sum()
        arms = middles - centre
        # the axis that the fibres go round
        axis = self.volume @ np.cross(arms, self.fibres)
        across = np.linalg.svd(axis[None])[2][1:]
        turn = np.arctan2(arms @ across[1], arms @ across[0]) / (2.0 * np.pi)
        count = options.most_points
        return _between(np.mod(turn, 1.0) * count, count, closed=True)


def _between(place: Floats, count: int, *, closed: bool = False) -> sp.csr_array:
    """Return parts (t, c) of what lies at a ``place`` (t,) from 0 on between ``count`` slices.

    Slices without anything are left out.
    """
    before = np.floor(place).astype(np.int64)
    before = before % count if closed else np.minimum(before, count - 2)
    after = (before + 1) % count
    part = np.mod(place, count) - before
    each = np.arange(len(place))
    entries = np.concatenate([1.0 - part, part])
    places = np.concatenate([each, each]), np.concatenate([before, after])
    found = sp.csc_array((entries, places), shape=(len(place), count))
    return sp.csr_array(found[:, np.asarray(found.sum(axis=0)) > 0.0])


def _middles(parts: sp.csr_array, tets: Ints, volume: Floats, count: int) -> sp.csr_array:
    """Return the slices' mean places as rows (c, count) over the vertices of the tets (t, 4)."""
    quarters = np.full(tets.size, 0.25), (np.repeat(np.arange(len(tets)), 4), tets.ravel())
    weighed = parts.T @ sp.diags_array(volume)
    total = np.asarray(weighed.sum(axis=1))
    return sp.csr_array(
        sp.diags_array(1.0 / total) @ weighed @ sp.csr_array(quarters, shape=(len(tets), count))
    )
