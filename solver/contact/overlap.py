"""Overlap of the lips: vertices, and the places on what they have crossed."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import igl
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.contact.mouth import LIPS, Mouth
from solver.surface import Floats, Ints

INSIDE = 0.5  # winding number above which a place lies inside


@dataclass(frozen=True)
class OverlapOptions:
    """Options by which a lip counts as in the other one."""

    outside_mm: float = 0.05  # a vertex is looked at this far outside its own skin
    deepest_mm: float = 6.0  # flesh of a lip is thicker than this: nothing deeper is looked for
    beside_mm: float = 1.0  # what is crossed is inside itself, or some vertex this near to it is
    back: float = 0.3  # least cosine between the way back out and the normals of the two skins


@dataclass(frozen=True)
class Overlap:
    """h vertices of the mouth, each with the nearest point of the surface it has crossed.

    ids
        (h,) vertices, sorted.
    corners, shares
        (h, 3) the triangle that holds the nearest point, and barycentric shares in it.
    depth
        (h,) mm from the vertex to that point.
    out
        (h, 3) unit vectors from the vertex to that point.
    """

    ids: Ints
    corners: Ints
    shares: Floats
    depth: Floats
    out: Floats

    @classmethod
    def at(cls, points: Floats, ids: Ints, corners: Ints, shares: Floats) -> Overlap:
        """Measure the depths at ``points`` (m, 3)."""
        gap = np.einsum("hc,hci->hi", shares, points[corners]) - points[ids]
        depth = np.linalg.norm(gap, axis=1)
        return cls(ids, corners, shares, depth, gap / np.maximum(depth, 1e-12)[:, None])

    def where(self, mask: NDArray[np.bool_]) -> Overlap:
        """Return the rows of a mask (h,)."""
        return Overlap(*(part[mask] for part in astuple(self)))


def inside_lips(mouth: Mouth, points: Floats, normals: Floats, outside_mm: float) -> Ints:
    """Return those vertices of the lips (h,) that lie in flesh not under their own skin.

    By the generalised winding number (Jacobson et al. 2013) of the skin around the mouth, an open
    surface: it is above one in the flesh of two lips, and well below a half outside.
    """
    lips = np.flatnonzero(mouth.label == LIPS)
    beside = np.ascontiguousarray(points[lips] + outside_mm * normals[lips])
    winding = igl.fast_winding_number(points, mouth.flesh, beside)
    return lips[np.asarray(winding) > INSIDE]


def between_lips(
    mouth: Mouth, points: Floats, options: OverlapOptions = OverlapOptions()
) -> Overlap:
    """Find the overlap of the lips at ``points`` (m, 3) of the mouth.

    Of all skin that is inside, the nearest that faces a vertex: skins in contact have opposed
    normals, which keeps a vertex's own surroundings out.
    """
    normals = mouth.normals(points)
    inside = inside_lips(mouth, points, normals, options.outside_mm)
    if not len(inside):
        nothing = np.empty((0, 3))
        return Overlap.at(points, inside, nothing.astype(np.int64), nothing)
    # a thin lip's own other side faces its vertices too, but nothing there is inside
    beside, _ = cKDTree(points[inside]).query(points, distance_upper_bound=options.beside_mm)
    crossed = np.flatnonzero((mouth.label == LIPS) & np.isfinite(beside))
    partner = _facing(points, normals, inside, crossed, options.deepest_mm)
    ids, partner = inside[partner >= 0], partner[partner >= 0]
    found = Overlap.at(points, ids, *_nearest(points, ids, partner, mouth.flesh, *mouth.rings))
    other = np.einsum("hc,hci,hi->h", found.shares, normals[found.corners], found.out)
    own = np.einsum("hi,hi->h", normals[ids], found.out)
    return found.where((other > options.back) & (own < -options.back))


@nb.njit(cache=True)
def _facing(points: Floats, normals: Floats, ids: Ints, among: Ints, deepest: float) -> Ints:
    """Return for each of some vertices the nearest of others that faces it; -1 where none does."""
    out = np.full(len(ids), -1)
    where, which = points[among], normals[among]
    for a in range(len(ids)):
        x, y, z = points[ids[a]]
        u, v, w = normals[ids[a]]
        best = deepest**2
        for k in range(len(among)):
            dx, dy, dz = where[k, 0] - x, where[k, 1] - y, where[k, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared < best and u * which[k, 0] + v * which[k, 1] + w * which[k, 2] < 0.0:
                best = squared
                out[a] = among[k]
    return out


@nb.njit(cache=True)
def _nearest(
    points: Floats, ids: Ints, partner: Ints, faces: Ints, start: Ints, number: Ints
) -> tuple[Ints, Floats]:
    """Return the triangle around ``partner`` nearest to each point, by corners, and the shares."""
    corners = np.empty((len(ids), 3), dtype=np.int64)
    shares = np.empty((len(ids), 3))
    for k in range(len(ids)):
        p = points[ids[k]]
        best = np.inf
        for entry in range(start[partner[k]], start[partner[k] + 1]):
            face = faces[number[entry]]
            own = _in_triangle(p, points[face[0]], points[face[1]], points[face[2]])
            gap = p - own[0] * points[face[0]] - own[1] * points[face[1]] - own[2] * points[face[2]]
            squared = gap @ gap
            if squared < best:
                best = squared
                corners[k] = face
                shares[k] = own
    return corners, shares


@nb.njit(cache=True)
def _in_triangle(p: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the barycentric shares of the triangle's point nearest to p.

    By the regions of corners, edges and the inside: Ericson, Real-Time Collision Detection, 5.1.5.
    """
    ab, ac = b - a, c - a
    d1, d2 = ab @ (p - a), ac @ (p - a)
    if d1 <= 0.0 and d2 <= 0.0:
        return np.array([1.0, 0.0, 0.0])
    d3, d4 = ab @ (p - b), ac @ (p - b)
    if d3 >= 0.0 and d4 <= d3:
        return np.array([0.0, 1.0, 0.0])
    d5, d6 = ab @ (p - c), ac @ (p - c)
    if d6 >= 0.0 and d5 <= d6:
        return np.array([0.0, 0.0, 1.0])
    on_c = d1 * d4 - d3 * d2
    if on_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return np.array([1.0 - t, t, 0.0])
    on_b = d5 * d2 - d1 * d6
    if on_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return np.array([1.0 - t, 0.0, t])
    on_a = d3 * d6 - d5 * d4
    if on_a <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return np.array([0.0, 1.0 - t, t])
    whole = on_a + on_b + on_c
    return np.array([on_a, on_b, on_c]) / whole
