"""Mend in a raw scan what has one remedy, and count it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from solver.meshio.mesh import alike, weld
from solver.meshio.raw import RawScan
from solver.similarity import Similarity
from solver.surface import Floats, Ints, area_normals

# A triangle is flat if twice its area is less than this share of its longest edge squared.
FLAT = 1e-7
# A coordinate beyond this counts as infinite: distances from it cannot be measured.
ENDLESS = 1e100
# Fewer vertices in the place of another are separate parts that touch, and stay.
WELDED_SHARE = 0.02


@dataclass(frozen=True)
class Mending:
    """Counts of each fault of a raw scan.

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
        return _pick(scan, kept, scan.faces), counts
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
    return _pick(scan, kept[used], (np.cumsum(used) - 1)[faces]), counts


def edge_counts(faces: Ints) -> tuple[Ints, Ints]:
    """Return the edges (e, 2), lower vertex first, and how many triangles have each."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    size = int(edges.max(initial=0)) + 1
    keys = np.sort(edges[:, 0] * size + edges[:, 1])
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    counts = np.diff(first, append=len(keys))
    return np.stack([keys[first] // size, keys[first] % size], axis=1), counts


def _pick(scan: RawScan, vertices: Ints, faces: Ints) -> RawScan:
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


# Points spread evenly over a scan, with normals: what poses and fits are found from.


NEIGHBOURS = 12  # of a point of a cloud, on a plane


@dataclass(frozen=True)
class Samples:
    """Points (n, 3) with unit normals (n, 3), whose signs mean nothing unless ``oriented``."""

    points: Floats
    normals: Floats
    oriented: bool

    def transform(self, motion: Similarity) -> Samples:
        """Return the samples in another frame."""
        return Samples(motion(self.points), motion.turn(self.normals), self.oriented)


def sample(
    vertices: Floats, faces: Ints, normals: Floats | None, count: int, seed: int = 0
) -> Samples:
    """Return about ``count`` points, spread by area over triangles or by space over a cloud.

    All vertices must be finite. Without faces or ``normals`` the normals are found from the
    neighbours, and their signs mean nothing.
    """
    rng = np.random.default_rng(seed)
    if len(faces):
        return _on_triangles(vertices, faces, count, rng)
    chosen = _spread(vertices, count, rng)
    points = vertices[chosen]
    if normals is not None:
        return Samples(points, _unit(normals[chosen]), True)
    return Samples(points, estimated_normals(points, vertices), False)


def _on_triangles(vertices: Floats, faces: Ints, count: int, rng: np.random.Generator) -> Samples:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = area_normals(vertices, faces)
    area = np.linalg.norm(cross, axis=1)
    ends = np.cumsum(area)
    if ends[-1] <= 0:
        return Samples(vertices[:1], np.array([[0.0, 0.0, 1.0]]), False)
    steps = (np.arange(count) + rng.random(count)) / count
    chosen = np.minimum(np.searchsorted(ends, steps * ends[-1]), len(faces) - 1)
    u, v = rng.random((2, count, 1))
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    points = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    return Samples(points, _unit(cross[chosen]), True)


def _spread(points: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Return the numbers of one random point of each cube of a grid with about ``count`` cubes."""
    if len(points) <= count:
        return np.arange(len(points))
    order = rng.permutation(len(points))
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    size = float((high - low).max())
    cells = np.sqrt(count / 2)  # a surface in a cube of n cells a side passes about 2 n^2 of them
    for _ in range(4):
        numbers = np.floor((points[order] - low) / (size / cells + 1e-30)).astype(np.int64)
        keys = (numbers * np.array([1, 1_000_003, 1_000_003**2])).sum(axis=1)
        _, first = np.unique(keys, return_index=True)
        if 0.7 < len(first) / count < 1.4:
            break
        cells *= np.sqrt(count / len(first))
    return np.asarray(order[np.sort(first)[:count]], np.int64)


def estimated_normals(points: Floats, cloud: Floats) -> Floats:
    """Return normals (n, 3), of either sign, of planes through the neighbours in ``cloud``."""
    tree = KDTree(cloud)
    _, near = tree.query(points, k=min(NEIGHBOURS, len(cloud)))
    offsets = cloud[near] - cloud[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    return np.asarray(axes[:, :, 0])


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-30))
