"""Free-form registration: every skin vertex on its own, as smooth as the data allow.

    min over d  sum_i w_i A_i |d_i - p_i|^2  +  l^4 |Laplacian d|^2  +  m l^2 |grad d|^2
              + sum over touching (i, j) of k_ij |x_i + d_i - x_j - d_j - gap_ij|^2

d are displacements (mm) from a start shape, p_i the way to the scan's tangent plane at the closest
point, A_i the vertex's area and l the length (mm) below which detail is smoothed. From round to
round l shrinks, as the stiffness does in Amberg, Romdhani & Vetter, "Optimal step nonrigid ICP
algorithms for surface registration" (CVPR 2007). Bending is measured by the discrete biharmonic
energy (Botsch & Kobbelt 2004); what the scan does not show follows from it. Lips that lie close in
the start keep the gap they have in the template, as no scanner sees between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from solver.mechanics.linear import Rslab
from solver.registration.scan_surface import ScanSurface
from solver.registration.shape_fit import Pins, find_correspondences
from solver.registration.topology import Topology
from solver.similarity import Similarity
from solver.surface import (
    Floats,
    Ints,
    Surface,
    adjacency,
    area_normals,
    own_numbers,
    vertex_areas,
    vertex_normals,
)


@dataclass(frozen=True)
class FreeFormOptions:
    """Weights of the free form."""

    membrane: float = 0.02  # m: keeps what the scan does not show from swinging out
    cotangent: tuple[float, float] = (0.05, 4.0)  # bounds of the Laplacian's weights
    touch_fades_mm: float = 1.5  # lips may be apart in the start and still be closed
    lip_strength: float = 5.0  # k of a touching pair, by the weight of a vertex in the scan
    pin_mm2: float = 20.0  # area of skin that a landmark speaks for


FREE_FORM = FreeFormOptions()


@dataclass(frozen=True)
class Round:
    """One round: smoothing ``length`` and ``reach`` of the closest points, in mm.

    A ``compatible`` round follows points that face the same way, and so moves vertices along the
    surface to where they belong; the others follow the tangent planes at the closest points.
    """

    length: float
    reach: float
    compatible: bool = False


def _rounds(compatible: bool, *groups: tuple[float, float, int]) -> tuple[Round, ...]:
    """Return the rounds of (length, reach, how many)."""
    return tuple(Round(length, reach, compatible) for length, reach, n in groups for _ in range(n))


# From a start that a shape model has brought close.
REFINE = (
    *_rounds(True, (30, 8, 4), (20, 6, 4), (12, 5, 6)),
    *_rounds(False, (12, 5, 1), (10, 5, 1), (8, 4, 1), (6, 4, 1), (5, 3, 1), (4, 3, 2)),
    *_rounds(False, (3.5, 2.5, 3)),
)
# From another person's shape, or another expression.
FROM_AFAR = (
    *_rounds(True, (50, 12, 6), (30, 10, 6), (20, 8, 6), (12, 6, 6)),
    *_rounds(False, (9, 5, 2), (7, 5, 1), (7, 4, 1), (6, 4, 2), (5, 3, 2), (4, 3, 3)),
)


class Skin:
    """The deforming part of a template at ``start`` (n, 3), ready to be smoothed."""

    def __init__(self, start: Floats, topology: Topology) -> None:
        self.vertices, self.faces = own_numbers(topology.flesh)
        self.start = start[self.vertices]
        self.outer = np.searchsorted(self.vertices, topology.outer)
        self._membrane, self.area = laplacian(Surface(self.start, self.faces))
        self._bending = self._membrane @ sp.diags_array(1 / self.area) @ self._membrane
        self._touch, self._closing = self._lips(topology)
        pattern = sp.csr_array(abs(self._bending) + abs(self._membrane) + abs(self._touch))
        pattern.sort_indices()
        entries = pattern.tocoo()
        self._pattern = pattern
        self._diagonal = entries.row == entries.col
        self._solver = Rslab(pattern)

    def smooth(self, goals: Floats, weights: Floats, length: float) -> Floats:
        """Return the displacements (k, 3) that meet ``goals`` (k, 3) as ``weights`` (k,) say."""
        data = weights * self.area
        stiffness = (
            length**4 * self._bending
            + FREE_FORM.membrane * length**2 * self._membrane
            + self._touch
        )
        # adding 0 x pattern keeps the entries of all parts
        matrix = sp.csr_array(stiffness + 0 * self._pattern)
        matrix.sort_indices()
        matrix.data[self._diagonal] += data + 1e-6 * self.area
        factor = self._solver.factor(matrix.data)
        return factor.solve(data[:, None] * goals + self._closing)

    def _lips(self, topology: Topology) -> tuple[sp.csr_array, Floats]:
        """Return the matrix of the touching pairs' springs, and the force that closes them."""
        rest = topology.template.skin.vertices[self.vertices]
        one, other = np.searchsorted(self.vertices, topology.touching).T
        closing = rest[one] - rest[other] - (self.start[one] - self.start[other])
        strength = np.exp(-np.sum((closing / FREE_FORM.touch_fades_mm) ** 2, axis=1))
        strength *= FREE_FORM.lip_strength * np.minimum(self.area[one], self.area[other])
        rows = np.tile(np.arange(len(one)), 2)
        ends = (rows, np.concatenate([one, other]))
        signs = np.repeat([1.0, -1.0], len(one))
        difference = sp.csr_array((signs, ends), shape=(len(one), len(rest)))
        weighted = difference.T @ sp.diags_array(strength)
        return sp.csr_array(weighted @ difference), weighted @ closing


def free_form(
    scan: ScanSurface,
    motion: Similarity,
    start: Floats,
    topology: Topology,
    schedule: tuple[Round, ...],
    pins: Pins | None = None,
) -> Floats:
    """Return the vertices (n, 3) of ``start`` (n, 3) moved onto the scan.

    ``motion`` takes the scan into the frame of ``start``, ``schedule`` has the rounds, coarse to
    fine. Landmarks (``pins``) guide the rounds that follow compatible points.
    """
    skin = Skin(start, topology)
    moved = np.zeros_like(skin.start)
    for stage in schedule:
        current = skin.start + moved
        normals = vertex_normals(Surface(current, skin.faces))[skin.outer]
        here = current[skin.outer]
        pairs = find_correspondences(
            scan, motion, here, normals, stage.reach, compatible=stage.compatible
        )
        goals = moved.copy()
        weights = np.zeros(len(moved))
        if stage.compatible:
            goals[skin.outer] += pairs.points - here
        else:
            goals[skin.outer] += pairs.offset[:, None] * pairs.normals
        weights[skin.outer] = pairs.weights
        if pins is not None and stage.compatible:
            numbers = np.searchsorted(skin.vertices, pins.vertices)
            goals[numbers] = motion(pins.points) - skin.start[numbers]
            weights[numbers] = FREE_FORM.pin_mm2 / skin.area[numbers]
        moved = skin.smooth(goals, weights, stage.length)
    result = start.copy()
    result[skin.vertices] += moved
    return result


def laplacian(surface: Surface) -> tuple[sp.csr_array, Floats]:
    """Return the cotangent Laplacian (positive) with bounded weights, and vertex areas (mm^2)."""
    weights = sp.coo_array(igl.cotmatrix(surface.vertices, surface.faces))
    weights.data = np.clip(weights.data, *FREE_FORM.cotangent)
    weights.data[weights.row == weights.col] = 0.0
    weights.eliminate_zeros()
    area = vertex_areas(surface.vertices, surface.faces)
    return _from_weights(weights.tocsr()), np.maximum(area, 0.02 * np.median(area))


def _from_weights(weights: sp.csr_array) -> sp.csr_array:
    return sp.csr_array(sp.diags_array(weights.sum(axis=1)) - weights)


# Triangles that registration has turned over, and laying them flat again.


WIDENINGS = 10  # rings that a patch about a fold grows by at most
SHORTEST_MM = 0.05  # edge that counts


def folded_triangles(before: Floats, after: Floats, faces: Ints) -> Ints:
    """Return the numbers of the faces (f, 3) that oppose the skin around them, but did not before.

    A triangle opposes the skin where its normal points away from the mean of its vertices'
    normals. ``before`` and ``after`` are vertices (n, 3).
    """
    return np.flatnonzero((_agreement(after, faces) < 0) & (_agreement(before, faces) >= 0))


def unfold(before: Floats, after: Floats, faces: Ints) -> Floats:
    """Return ``after`` (n, 3) without its triangles turned over against ``before`` (n, 3).

    Around every fold the displacement from ``before`` is laid anew, with the least bending that
    fits the skin beside it; its patch grows ring by ring until the fold is gone. Folds that are
    left after :data:`WIDENINGS` rings stay.
    """
    graph = adjacency(faces, len(before))
    bending = _bending(before, graph)
    inside = np.zeros(0, dtype=np.int64)
    for rings in range(1, WIDENINGS + 1):
        folds = folded_triangles(before, after, faces)
        if not len(folds):
            break
        patch = np.zeros(len(before))
        patch[faces[folds]] = 1.0
        for _ in range(rings):
            patch = graph @ patch + patch
        inside = np.union1d(inside, np.flatnonzero(patch))
        outside = np.setdiff1d(np.arange(len(before)), inside)
        displacement = after - before
        rows = bending[inside]
        matrix = sp.csc_array(rows[:, inside] + 1e-9 * sp.eye_array(len(inside)))
        laid = spsolve(matrix, -(rows[:, outside] @ displacement[outside]))
        after = after.copy()
        after[inside] = before[inside] + laid
    return after


def _bending(vertices: Floats, graph: sp.csr_array) -> sp.csr_array:
    """Return the squared Laplacian with weights 1 / length^2: close vertices move alike."""
    weights = graph.tocoo()
    squared = np.sum((vertices[weights.row] - vertices[weights.col]) ** 2, axis=1)
    weights.data = 1 / (squared + SHORTEST_MM**2)
    laplacian = _from_weights(weights.tocsr())
    return sp.csr_array(laplacian @ laplacian)


def _agreement(vertices: Floats, faces: Ints) -> Floats:
    normal = area_normals(vertices, faces)
    around = vertex_normals(Surface(vertices, faces))[faces].mean(axis=1)
    return np.asarray(np.einsum("nd,nd->n", normal, around))
