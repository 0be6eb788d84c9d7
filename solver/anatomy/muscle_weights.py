"""Muscles in tetrahedra: the initial S, and the directions of fibres.

S (t, m + 1) holds the part of each tetrahedron that each muscle fills; its entries are the muscles
that may ever act there.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
import trimesh
from scipy.spatial import cKDTree

from solver.anatomy.template import Muscle
from solver.anatomy.tetrahedra import volumes
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.surface import Floats, Ints, Surface, area_normals, own_numbers, winding_numbers

CANDIDATE_MM = 10.0  # a muscle may act in the tets within this distance (the paper's sparsity of S)
# Eight equal parts of a tetrahedron: each corner is half way between two of its corners.
_OCTASECTION = (
    ((0, 0), (0, 1), (0, 2), (0, 3)),
    ((1, 1), (0, 1), (1, 2), (1, 3)),
    ((2, 2), (0, 2), (1, 2), (2, 3)),
    ((3, 3), (0, 3), (1, 3), (2, 3)),
    ((0, 2), (1, 3), (0, 1), (0, 3)),
    ((0, 2), (1, 3), (0, 3), (2, 3)),
    ((0, 2), (1, 3), (2, 3), (1, 2)),
    ((0, 2), (1, 3), (1, 2), (0, 1)),
)


@dataclass(frozen=True)
class SamplingOptions:
    """Fineness of the sampling of tetrahedra, at the centres of 8^level parts."""

    near_level: int = 1  # to find candidates
    level: int = 2  # for volume fractions
    fine_level: int = 3  # for those of small muscles, which are thin
    fine_below_mm3: float = 600.0  # volume of a small muscle


SAMPLING = SamplingOptions()


def initial_weights(vertices: Floats, tets: Ints, muscles: list[Surface]) -> sp.csr_array:
    """Return S (t, m + 1): volume fractions of muscles in tetrahedra, column 0 the passive rest.

    Stored entries are the candidates: the passive column and every muscle within
    :data:`CANDIDATE_MM` of a tetrahedron, explicit zeros included. Rows sum to one.
    """
    parts = []
    for column, muscle in enumerate(muscles, start=1):
        candidates = _candidates(vertices, tets, muscle)
        fractions = _fractions(vertices[tets[candidates]], muscle)
        parts.append((candidates, np.full(len(candidates), column), fractions))
    rows, columns, fractions = (np.concatenate(part) for part in zip(*parts, strict=True))
    sizes = np.array([enclosed_volume(muscle) for muscle in muscles])
    fractions = _without_overlap(rows, fractions, sizes[columns - 1])
    every = np.arange(len(tets))
    passive = 1.0 - np.minimum(np.bincount(rows, fractions, minlength=len(tets)), 1.0)
    places = np.concatenate([every, rows]), np.concatenate([0 * every, columns])
    values = np.concatenate([passive, fractions])
    return sp.csr_array((values, places), shape=(len(tets), len(muscles) + 1))


def _without_overlap(rows: Ints, fractions: Floats, sizes: Floats) -> Floats:
    """Return the fractions (k,) with no tet, of number ``rows`` (k,), filled more than wholly.

    Muscles overlap where they interlace. Each gives up a part of the excess by its fraction times
    its size in mm^3, ``sizes`` (k,): large muscles hardly miss what would be half of a small one.
    """
    excess = np.maximum(np.bincount(rows, fractions) - 1.0, 0.0)
    yielding = fractions * sizes
    total = np.maximum(np.bincount(rows, yielding), 1e-12)
    left = np.maximum(fractions - (excess / total)[rows] * yielding, 0.0)
    return np.asarray(left / np.maximum(np.bincount(rows, left), 1.0)[rows])


def muscle_volumes(vertices: Floats, tets: Ints, weights: sp.csr_array) -> Floats:
    """Return the volumes (m,) in mm^3 that the muscles have in the tetrahedra."""
    return volumes_by_muscle(volumes(vertices, tets), weights)


def volumes_by_muscle(volumes: Floats, S: sp.csr_array) -> Floats:
    """Return the volumes (m,) of the muscles' flesh in S, ``volumes`` (n,) being the tets'."""
    return np.asarray(S.T @ volumes)[1:]


def enclosed_volume(surface: Surface, samples: int = 40_000) -> float:
    """Return the volume in mm^3 of the points that a surface winds around.

    The volume of a closed surface is a sum over its triangles. With gaps, or pieces inside out, it
    is counted on a grid of ``samples`` along the surface's principal axes, to about 2 %.
    """
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    if mesh.is_watertight and mesh.is_winding_consistent:
        return abs(signed_volume(surface))
    middle = surface.vertices.mean(axis=0)
    axes = np.linalg.svd(surface.vertices - middle, full_matrices=False)[2]
    local = (surface.vertices - middle) @ axes.T
    lo = local.min(axis=0)
    size = np.ptp(local, axis=0)
    box = float(np.prod(size))
    counts = np.ceil(size / (box / samples) ** (1 / 3)).astype(int)
    grid = lo + size * (np.indices(tuple(counts)).reshape(3, -1).T + 0.5) / counts
    return box * float(contains(surface, grid @ axes + middle).mean())


def signed_volume(surface: Surface) -> float:
    """Return the volume in mm^3 inside a closed surface, negative if it is turned inwards."""
    corners = surface.vertices[surface.faces] - surface.vertices.mean(axis=0)
    return float(np.linalg.det(corners).sum() / 6.0)


def contains(surface: Surface, points: Floats) -> np.ndarray:
    """Return (n,) True where a point lies inside; the surface may have gaps or be inside out."""
    return np.abs(winding_numbers(surface, points)) > 0.5


def _fractions(corners: Floats, muscle: Surface) -> Floats:
    """Return which part (t,) of tetrahedra with ``corners`` (t, 4, 3) a muscle fills."""
    touched = np.flatnonzero(_near_tets(corners, muscle))
    small = enclosed_volume(muscle) < SAMPLING.fine_below_mm3
    samples = _samples(SAMPLING.fine_level if small else SAMPLING.level)
    points = np.einsum("sk,tkd->tsd", samples, corners[touched])
    inside = contains(muscle, points.reshape(-1, 3)).reshape(len(touched), len(samples))
    fractions = np.zeros(len(corners))
    fractions[touched] = inside.mean(axis=1)
    return fractions


def _near_tets(corners: Floats, surface: Surface, distance: float = 0.0) -> np.ndarray:
    """Return (t,) True for tets that may lie within a distance of a surface, by their spheres."""
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    return is_within(centres, surface, distance + radii)


def _samples(level: int) -> Floats:
    """Return (8^level, 4) barycentric coordinates of the centres of equal parts."""
    parts = np.eye(4)[None]
    for _ in range(level):
        parts = parts[:, np.array(_OCTASECTION)].mean(axis=3).reshape(-1, 4, 4)
    return np.asarray(parts.mean(axis=1))


def _candidates(vertices: Floats, tets: Ints, surface: Surface) -> Ints:
    """Return the tetrahedra within :data:`CANDIDATE_MM` of a muscle, by corners and samples."""
    near = np.asarray(is_within(vertices, surface, CANDIDATE_MM)[tets].any(axis=1))
    others = np.flatnonzero(~near)
    corners = vertices[tets[others]]
    possible = _near_tets(corners, surface, CANDIDATE_MM)
    points = np.einsum("sk,tkd->tsd", _samples(SAMPLING.near_level), corners[possible])
    inside = is_within(points.reshape(-1, 3), surface, CANDIDATE_MM)
    near[others[possible]] = inside.reshape(points.shape[:2]).any(axis=1)
    return np.flatnonzero(near)


def is_within(points: Floats, surface: Surface, reach: Floats | float) -> np.ndarray:
    """Return (n,) True where a point lies inside a surface or within ``reach`` of it."""
    lo = surface.vertices.min(axis=0)
    hi = surface.vertices.max(axis=0)
    reach = np.broadcast_to(reach, len(points))
    gap = np.maximum(lo - points, points - hi).max(axis=1)
    near = np.flatnonzero(gap <= reach)
    result = np.zeros(len(points), dtype=bool)
    if len(near) == 0:
        return result
    squared = igl.point_mesh_squared_distance(points[near], surface.vertices, surface.faces)[0]
    distance = np.sqrt(squared)
    result[near] = distance <= reach[near]
    # A point deeper inside is at least as far from the sides of the bounding box.
    deep = near[~result[near] & (-gap[near] >= distance)]
    if len(deep):
        result[deep] = contains(surface, points[deep])
    return result


# Fibre directions of every muscle in every tetrahedron, by Laplace fields between attachments.
#
# Fibres run along the gradient of a potential u with div(sigma grad u) = 0 that grows from the
# origin to the insertion; sigma is the muscle's volume fraction of a tet, so that no fibre leaves
# the muscle sideways (the preferred directions of Ichim, Kadlecek, Kavan and Pauly, "Phace", 2017;
# Laplace-Dirichlet fibres are due to Bayer, Blake, Plank and Trayanova, 2012). Around a ring u has
# no ends: there it is an angle that grows by 2 pi on the way round.


@dataclass(frozen=True)
class FibreOptions:
    """Ends of muscles, and the flesh around them, in the potentials of fibres."""

    # Part of a muscle's length at each end where the potential is given. Less takes the top of a
    # dome, such as frontalis has, for the whole end, and fibres fan out from it.
    straight_end: float = 0.15
    # The same of a bent muscle. More takes its side, such as half a ring has, for its end.
    bent_end: float = 0.05
    # A muscle is bent if its middle lies off its axis by more than this part of its length.
    bent: float = 0.16
    reach_mm: float = 5.0  # muscle further than this from its candidates is outside the flesh
    conductivity: float = 0.01  # of the flesh around a muscle, for its candidates beside it
    # Weight of the potential's first guess, for pieces of flesh that no end touches.
    pull: float = 1e-6


FIBRES = FibreOptions()


def fibre_directions(
    vertices: Floats, tets: Ints, weights: sp.csr_array, muscles: tuple[Muscle, ...]
) -> Floats:
    """Return unit directions (nnz, 3), one for each stored entry of S, zero in column 0.

    ``vertices`` (p, 3) in mm and ``tets`` (n, 4) of positive volume are at rest. The entries of S,
    ``weights`` (n, m + 1), are the candidates and its values their volume fractions. Directions
    go from a muscle's origin to its insertion, or once around a ring; ``muscles`` are in the frame
    of the vertices.
    """
    entries, (gradients, sizes) = weights.tocoo(), shape_gradients(vertices, tets)
    directions = np.zeros((weights.nnz, 3))
    for column, muscle in enumerate(muscles, start=1):
        own = np.flatnonzero(entries.col == column)
        if len(own) == 0:
            continue
        rows = entries.row[own]
        weight = sizes[rows] * (entries.data[own] + FIBRES.conductivity)
        field = _Field(vertices, tets[rows], gradients[rows], weight)
        flow = field.around(muscle) if muscle.ring else field.along(muscle)
        length = np.linalg.norm(flow, axis=1, keepdims=True)
        directions[own] = np.where(length > 0, flow / np.where(length > 0, length, 1), muscle.fibre)
    return directions


def _bend(muscle: Muscle) -> float:
    """Return how far a muscle's middle lies off the line between its ends, by their distance."""
    corners = muscle.surface.vertices[muscle.surface.faces]
    normals = area_normals(muscle.surface.vertices, muscle.surface.faces)
    area = np.linalg.norm(normals, axis=1)
    off = np.average(corners.mean(axis=1), axis=0, weights=area)
    off = off - (muscle.origin + muscle.insertion) / 2
    off = off - muscle.fibre * (off @ muscle.fibre)
    return float(np.linalg.norm(off) / np.linalg.norm(muscle.insertion - muscle.origin))


class _Field:
    """Potentials on the candidates of one muscle, with the conductivity times volume of each."""

    def __init__(self, vertices: Floats, tets: Ints, gradients: Floats, weight: Floats) -> None:
        self._gradients = gradients
        self._weight = weight
        numbers, self._tets = own_numbers(tets)
        self._points = vertices[numbers]
        self._matrix = laplacian(gradients, weight, self._tets, len(numbers))

    def along(self, muscle: Muscle) -> Floats:
        """Return the gradient (t, 3) of the potential between a muscle's ends."""
        surface = muscle.surface.vertices
        # Muscle outside the flesh, such as the platysma below the cut, has no say.
        surface = surface[cKDTree(self._points).query(surface)[0] < FIBRES.reach_mm]
        if not len(surface):  # none of it is near enough to lead any flesh
            return np.zeros((len(self._tets), 3))
        extent = surface @ muscle.fibre
        low, high = np.quantile(extent, [0.02, 0.98])
        guess = (self._points @ muscle.fibre - low) / (high - low)
        place = (extent[cKDTree(surface).query(self._points)[1]] - low) / (high - low)
        end = FIBRES.bent_end if _bend(muscle) > FIBRES.bent else FIBRES.straight_end
        given = (place < end) | (place > 1 - end)
        return self._gradient(self._solve(np.zeros(len(guess)), guess, given))

    def around(self, muscle: Muscle) -> Floats:
        """Return the harmonic flow (t, 3) around a ring: the angle's gradient, made source-free."""
        surface = muscle.surface.vertices
        centre = (surface.min(axis=0) + surface.max(axis=0)) / 2
        across, up, _ = np.linalg.svd(surface - surface.mean(axis=0), full_matrices=False)[2]
        away = self._points - centre
        angle = np.arctan2(away @ up, away @ across)[self._tets]
        # Within a tet the angle does not jump by 2 pi.
        steps = np.angle(np.exp(1j * (angle - angle[:, :1])))
        turning = np.einsum("ti,tid->td", steps, self._gradients)
        sources = -np.einsum("t,tid,td->ti", self._weight, self._gradients, turning)
        load = np.zeros(len(self._points))
        np.add.at(load, self._tets, sources)
        correction = self._solve(load, np.zeros(len(load)), np.zeros(len(load), dtype=bool))
        return np.asarray(turning + self._gradient(correction))

    def _gradient(self, potential: Floats) -> Floats:
        return np.asarray(np.einsum("ti,tid->td", potential[self._tets], self._gradients))

    def _solve(self, load: Floats, guess: Floats, given: np.ndarray) -> Floats:
        """Return u (p,) with -div(sigma grad u) = ``load`` that is ``guess`` where it is given."""
        pull = FIBRES.pull * self._matrix.diagonal().mean()
        held = HarmonicExtension(self._matrix + pull * sp.eye_array(len(guess)), given)
        return held(guess, load=load + pull * guess)


def with_axis(name: str, surface: Surface, skull: Floats) -> Muscle:
    """Return a muscle whose axis is its longest extent, from the end nearer to ``skull`` (k, 3)."""
    centred = surface.vertices - surface.vertices.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    ends = muscle_ends(surface, axis)
    away = cKDTree(skull).query(ends)[0]
    origin, insertion = ends if away[0] <= away[1] else ends[::-1]
    fibre = (insertion - origin) / np.linalg.norm(insertion - origin)
    return Muscle(name, surface, fibre, origin, insertion)


def muscle_ends(surface: Surface, axis: Floats) -> Floats:
    """Return the centres (2, 3) of both ends along an axis."""
    return np.stack([end.mean(axis=0) for end in end_vertices(surface, axis)])


def end_vertices(surface: Surface, axis: Floats, part: float = 0.1) -> tuple[Floats, Floats]:
    """Return the vertices, (j, 3) and (k, 3), at both ends along an axis, each ``part`` of all."""
    along = surface.vertices @ axis
    low, high = np.quantile(along, [part, 1 - part])
    return surface.vertices[along <= low], surface.vertices[along >= high]
