"""Depths of lips and teeth inside each other, in a scan or in a fit."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import igl
import numba as nb
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.anatomy.contact_regions import LOWER, UPPER
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth, area_weighted_normals
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface, directed_edges, inside


@dataclass(frozen=True)
class OverlapOptions:
    """Options by which a lip counts as in the other one."""

    outside_mm: float = 0.05  # a vertex is looked at this far outside its own skin
    deepest_mm: float = 6.0  # flesh of a lip is thicker than this: nothing deeper is looked for
    beside_mm: float = 1.0  # what is crossed is inside itself, or some vertex this near to it is
    back: float = 0.3  # least cosine between the way back out and the normals of the two skins


@dataclass(frozen=True)
class NearOptions:
    """Options of :class:`NearLips`."""

    every: int = 3  # test one of so many vertices of a lip
    reach_mm: float = 4.0  # to the other lip, at most
    corner_mm: float = 3.5  # from a corner of the mouth, at least
    back: float = 0.3  # least cosine between one skin's normal and the other's, turned round


@dataclass(frozen=True)
class Overlap:
    """h vertices of the mouth, each with the nearest point of the surface it has crossed."""

    ids: Ints  # (h,) vertices, sorted
    corners: Ints  # (h, 3) the triangle that holds the nearest point,
    shares: Floats  # (h, 3) and barycentric shares in it
    depth: Floats  # (h,) mm from the vertex to that point
    out: Floats  # (h, 3) unit vectors from the vertex to that point

    @classmethod
    def at(cls, points: Floats, ids: Ints, corners: Ints, shares: Floats) -> Overlap:
        """Measure the depths at ``points`` (m, 3)."""
        gap = np.einsum("hc,hci->hi", shares, points[corners]) - points[ids]
        depth = np.linalg.norm(gap, axis=1)
        return cls(ids, corners, shares, depth, gap / np.maximum(depth, 1e-12)[:, None])

    def where(self, mask: NDArray[np.bool_]) -> Overlap:
        """Return the rows of a mask (h,)."""
        return Overlap(*(part[mask] for part in astuple(self)))


def between_lips(
    mouth: Mouth, points: Floats, options: OverlapOptions = OverlapOptions()
) -> Overlap:
    """Find the overlap of the lips at ``points`` (m, 3) of the mouth.

    A vertex is paired with the nearest skin inside that faces it: skins in contact have opposed
    normals, which keeps the vertex's own surroundings out.
    """
    normals = mouth.normals(points)
    lips = np.flatnonzero(mouth.label == LIPS)
    # the winding number of the skin around the mouth, an open surface, is above one in the flesh
    # of two lips, and well below a half outside
    just_outside = points[lips] + options.outside_mm * normals[lips]
    deep = lips[inside(Surface(points, mouth.flesh), just_outside)]
    if not len(deep):
        nothing = np.empty((0, 3))
        return Overlap.at(points, deep, nothing.astype(np.int64), nothing)
    # a thin lip's own other side faces its vertices too, but nothing there is inside
    beside, _ = cKDTree(points[deep]).query(points, distance_upper_bound=options.beside_mm)
    crossed = np.flatnonzero((mouth.label == LIPS) & np.isfinite(beside))
    partner = _facing(points, normals, deep, crossed, options.deepest_mm)
    # a lip that is folded at a corner of the mouth is in itself, not in the other
    other = (partner >= 0) & (mouth.side[partner] != mouth.side[deep])
    ids = deep[other]
    partner = partner[other]
    found = Overlap.at(points, ids, *_nearest(mouth, points, ids, partner))
    theirs = np.einsum("hc,hci,hi->h", found.shares, normals[found.corners], found.out)
    own = np.einsum("hi,hi->h", normals[ids], found.out)
    return found.where((theirs > options.back) & (own < -options.back))


class NearLips:
    """Estimate :func:`between_lips` by every third vertex, in a tenth of the time.

    A vertex of a lip is in the other where it is behind the nearest one there and that behind it,
    as their normals have it; its depth is that below the other's tangent plane. Corners of the
    mouth, where one lip goes over into the other, are left out. ``rest`` (m, 3) are the mouth's
    points in the neutral face.
    """

    def __init__(self, mouth: Mouth, rest: Floats, options: NearOptions = NearOptions()) -> None:
        self._options = options
        first, second = directed_edges(mouth.flesh).T
        corner = first[mouth.side[first] * mouth.side[second] < 0]
        inner = np.ones(len(rest), bool)
        if len(corner):
            near, _ = cKDTree(rest[corner]).query(rest, distance_upper_bound=options.corner_mm)
            inner = ~np.isfinite(near)
        sides = [np.flatnonzero((mouth.side == lip) & inner) for lip in (UPPER, LOWER)]
        self._pairs = [(own[:: options.every], other) for own, other in (sides, sides[::-1])]
        self._faces = mouth.faces[np.isin(mouth.faces, np.concatenate(sides)).any(axis=1)]

    def overlap(self, points: Floats) -> Overlap:
        """Estimate the overlap at ``points`` (m, 3) of the mouth, with tangent planes' depths."""
        options = self._options
        normals = area_weighted_normals(points, self._faces)
        ids = [np.empty(0, np.int64)]
        partners = [np.empty(0, np.int64)]
        for few, other in self._pairs:
            if not (len(few) and len(other)):
                continue
            tree = cKDTree(points[other])
            near, which = tree.query(points[few], distance_upper_bound=options.reach_mm)
            found = np.isfinite(near)
            ids.append(few[found])
            partners.append(other[which[found]])
        vertex = np.concatenate(ids)
        partner = np.concatenate(partners)
        gap = points[partner] - points[vertex]
        depth = np.einsum("hi,hi->h", gap, normals[partner])
        behind = np.einsum("hi,hi->h", gap, normals[vertex]) < 0.0
        opposed = np.einsum("hi,hi->h", normals[partner], normals[vertex]) < -options.back
        shares = np.tile([1.0, 0.0, 0.0], (len(vertex), 1))
        corners = np.repeat(partner[:, None], 3, axis=1)
        found = Overlap(vertex, corners, shares, depth, normals[partner])
        return found.where(behind & opposed & (depth > 0.0))


@nb.njit(cache=True)
def _facing(points: Floats, normals: Floats, ids: Ints, among: Ints, deepest: float) -> Ints:
    """Return for each of some vertices the nearest of others that faces it; -1 where none does."""
    out = np.full(len(ids), -1)
    where = points[among]
    which = normals[among]
    for a in range(len(ids)):
        x, y, z = points[ids[a]]
        u, v, w = normals[ids[a]]
        best = deepest**2
        for k in range(len(among)):
            dx = where[k, 0] - x
            dy = where[k, 1] - y
            dz = where[k, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared < best and u * which[k, 0] + v * which[k, 1] + w * which[k, 2] < 0.0:
                best = squared
                out[a] = among[k]
    return out


def _nearest(mouth: Mouth, points: Floats, ids: Ints, partner: Ints) -> tuple[Ints, Floats]:
    """Return the triangles around ``partner`` nearest to points, by corners, and the shares."""
    start, number = mouth.rings
    counts = start[partner + 1] - start[partner]
    row = np.repeat(np.arange(len(ids)), counts)
    first = np.cumsum(counts) - counts
    corners = mouth.flesh[number[start[partner][row] + np.arange(len(row)) - first[row]]]
    library: Any = trimesh.triangles
    places = library.closest_point(points[corners], points[ids[row]])
    squared = ((places - points[ids[row]]) ** 2).sum(axis=1)
    best = np.lexsort((squared, row))[first]
    shares = library.points_to_barycentric(points[corners[best]], places[best])
    return corners[best], shares


@dataclass(frozen=True)
class Crossing:
    """Depths in mm, zero where nothing crosses: the least motion that would undo it."""

    lips: float  # of a lip's vertex in the other lip
    vertex: int | None  # that skin vertex; None if none crosses
    upper_teeth: float | None  # of a lip's vertex in teeth; None in models without them
    lower_teeth: float | None
    bite: float | None  # of lower teeth in the upper ones; None without teeth


def crossing(mouth: Mouth, skin: Floats) -> Crossing:
    """Measure the skin (V, 3) of the scan topology: :meth:`Face.whole_skin`, or a scan.

    Raises :class:`InputError` (``scan.nan``) where a vertex of the mouth is not finite.
    """
    points = np.ascontiguousarray(skin[mouth.skin])
    wrong = mouth.skin[~np.isfinite(points).all(axis=1)]
    if len(wrong):
        message = f"vertex {wrong[0]} of the mouth is not finite"
        raise InputError("scan.nan", message, vertex=int(wrong[0]))
    return crossing_at(mouth, points)


def crossing_at(mouth: Mouth, points: Floats) -> Crossing:
    """Measure the positions (m, 3) of a mouth: :meth:`Mouth.points`, all finite."""
    lips = between_lips(mouth, points)
    deepest = int(mouth.skin[lips.ids[lips.depth.argmax()]]) if len(lips.ids) else None
    return Crossing(
        float(lips.depth.max(initial=0.0)),
        deepest,
        _in_teeth(mouth, points, LIPS, UPPER_TEETH),
        _in_teeth(mouth, points, LIPS, LOWER_TEETH),
        _in_teeth(mouth, points, LOWER_TEETH, UPPER_TEETH),
    )


def _in_teeth(mouth: Mouth, points: Floats, part: int, teeth: int) -> float | None:
    """Return how deep a vertex of a part lies in teeth, closed surfaces; None without either."""
    faces: Ints = mouth.faces_of(teeth)
    vertices = points[mouth.label == part]
    if not (len(faces) and len(vertices)):
        return None
    distance, *_ = igl.signed_distance(
        np.ascontiguousarray(vertices), points, faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )
    return float(np.maximum(-np.asarray(distance), 0.0).max(initial=0.0))


def depth_inside(points: Floats, surface: Surface) -> float:
    """Return how deep the deepest of points (k, 3) lies inside a surface, 0 if none does."""
    deep = np.ascontiguousarray(points[inside(surface, points)])
    if not len(deep):
        return 0.0
    squared, *_ = igl.point_mesh_squared_distance(deep, surface.vertices, surface.faces)
    return float(np.sqrt(np.max(squared)))
