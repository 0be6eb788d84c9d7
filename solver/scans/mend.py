"""What can be mended in a raw scan without asking: it is mended, counted and reported."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray

from solver.scans.raw import RawScan
from solver.scans.weld import alike, weld
from solver.surface import Floats, Ints
from solver.triangles import area_normals

FLAT = 1e-7
"""A triangle is flat if twice its area is less than this share of its longest edge squared."""
ENDLESS = 1e100
"""A coordinate beyond this counts as infinite: distances from it can not be measured."""
WELDED_SHARE = 0.02
"""Fewer vertices in the place of another are separate parts that touch, and stay."""


@dataclass(frozen=True)
class Mending:
    """How many of each fault a raw scan had.

    ``not_finite`` vertices, the first of them ``first_not_finite`` (-1 for none); ``duplicate``
    vertices (in the place of another); ``flat`` triangles (no area); ``repeated`` triangles (the
    same corners as another); ``unused`` vertices (in no triangle); ``non_manifold`` edges (of three
    triangles or more); ``flipped`` triangles (wound against the most of their piece).
    """

    not_finite: int = 0
    first_not_finite: int = -1
    duplicate: int = 0
    flat: int = 0
    repeated: int = 0
    unused: int = 0
    non_manifold: int = 0
    flipped: int = 0


def mend(scan: RawScan) -> tuple[RawScan, Mending]:
    """Return the scan without the faults that have one remedy, and how many there were.

    Vertices that are not finite go, with their triangles; many vertices in the place of others
    become one with them; flat and repeated triangles go; the triangles of each piece are wound
    alike, as most of them were; vertices that no triangle uses go. The unit and axes stay.
    """
    finite = np.asarray((np.abs(scan.vertices) < ENDLESS).all(axis=1))
    lost = np.flatnonzero(~finite)
    numbers = np.flatnonzero(finite)
    first, place = weld(scan.vertices[finite])
    duplicate = len(numbers) - len(first)
    if duplicate <= WELDED_SHARE * len(numbers):
        first = place = np.arange(len(numbers), dtype=np.int64)
    new_number = np.full(len(finite), -1)
    new_number[numbers] = place
    faces: Ints = new_number[scan.faces[finite[scan.faces].all(axis=1)]]
    kept = numbers[first]
    counts = Mending(len(lost), int(lost[0]) if len(lost) else -1, duplicate)
    if len(scan.faces) == 0:
        return _picked(scan, kept, scan.faces), counts
    flat = _is_flat(scan.vertices[kept], faces)
    faces = faces[~flat]
    single, _ = alike(np.sort(faces, axis=1).astype(np.uint64))
    repeated = len(faces) - len(single)
    faces, flipped = _wound_alike(faces[single])
    used = np.zeros(len(kept), bool)
    used[faces] = True
    counts = replace(
        counts,
        flat=int(flat.sum()),
        repeated=repeated,
        unused=int((~used).sum()),
        non_manifold=int((edge_counts(faces)[1] > 2).sum()),
        flipped=flipped,
    )
    return _picked(scan, kept[used], (np.cumsum(used) - 1)[faces]), counts


def edge_counts(faces: Ints) -> tuple[Ints, Ints]:
    """Return the edges (e, 2), lower vertex first, and how many triangles have each."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    size = int(edges.max(initial=0)) + 1
    keys = np.sort(edges[:, 0] * size + edges[:, 1])
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    counts = np.diff(first, append=len(keys))
    return np.stack([keys[first] // size, keys[first] % size], axis=1), counts


def _picked(scan: RawScan, vertices: Ints, faces: Ints) -> RawScan:
    def rows(values: Floats | None) -> Floats | None:
        return None if values is None else values[vertices]

    return replace(
        scan,
        vertices=scan.vertices[vertices],
        faces=faces.astype(np.int64),
        normals=rows(scan.normals),
        colours=rows(scan.colours),
    )


def _is_flat(vertices: Floats, faces: Ints) -> NDArray[np.bool_]:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    double_area = np.linalg.norm(area_normals(vertices, faces), axis=1)
    longest = np.max([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)], axis=0)
    return np.asarray(double_area <= FLAT * longest)


def _wound_alike(faces: Ints) -> tuple[Ints, int]:
    """Return the triangles, those turned round that the most of their piece run against."""
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = np.sort(ends[:, 0] * (int(faces.max(initial=0)) + 1) + ends[:, 1])
    if (np.diff(directed) > 0).all():  # neighbours run along their edge in opposite ways
        return faces, 0
    wound, piece = igl.bfs_orient(faces)
    wound = np.asarray(wound, np.int64)
    turned = (wound != faces).any(axis=1)
    against = (np.bincount(piece, turned) > 0.5 * np.bincount(piece))[piece]
    wound[against] = wound[against][:, ::-1]
    return wound, int((turned ^ against).sum())
