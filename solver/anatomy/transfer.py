"""Carrying a template's anatomy into a person whose neutral scan has the template's topology.

A smooth warp between both skins carries everything. Then the tets are relaxed, pulled by skin and
bones, by one energy over all vertices x, the shape of every tet and springs to the guides:

    E(x) = sum_t c_t q_t(x)^4 + sum_i w_i |(R x)_i - g_i|^2

q is the mean-ratio distortion of a tet against the regular one, |F|^2 / (3 (det F)^(2/3)): one for
a regular tet of any size, infinite for a flat one. Below zero det F is replaced by the regularised
chi(det F) of Garanzha, Kaporin, Kudryavtseva, Protais, Ray and Sokolov (Foldover-free maps in 50
lines of code, ACM TOG 2021), which is finite and pushes inverted tets right. The fourth power is
for the worst tets: good ones are left to the springs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numba as nb
import numpy as np
import scipy.sparse as sp
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from solver.anatomy.embedding import at_nearest, tet_binder
from solver.anatomy.template import Muscle, Template, TemplateMesh
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.anatomy.warp import SkinDepth, Warp, interpolate, spread
from solver.errors import SolveError
from solver.surface import Floats, Ints, Surface

POWER = 4.0  # of q in the energy: a kernel's constant
# Edges of the regular tet, in columns.
_REGULAR = np.array([[1.0, 0.5, 0.5], [0.0, 0.75**0.5, 0.75**0.5 / 3], [0.0, 0.0, (2 / 3) ** 0.5]])
_INVERSE = np.linalg.inv(_REGULAR)


@dataclass(frozen=True)
class RelaxationOptions:
    """Weights and rounds of the relaxation."""

    stiffness: float = 0.1  # c of a tet at first
    # Regularisation of chi, as a part of the volume of a tet of mean edge length, to untangle.
    untangling: float = 0.1
    smoothing: float = 0.01  # the same, for the result
    wanted_deg: float = 12.0  # tets with a smaller dihedral angle are stiffened and relaxed again
    stiffening: float = 3.0  # the factor of each such round
    rounds: int = 6
    iterations: int = 500  # of L-BFGS in the first round; later ones have a small way to go
    later_iterations: int = 120


RELAXATION = RelaxationOptions()


@dataclass(frozen=True)
class Guides:
    """Springs: ``rows`` (k, p) on the vertices, ``targets`` (k, 3) mm, ``weights`` (k,) 1/mm^2."""

    rows: sp.csr_array
    targets: Floats
    weights: Floats

    @classmethod
    def of_vertices(cls, ids: Ints, targets: Floats, weight: float, count: int) -> Guides:
        """Return springs of equal weight from the vertices ``ids`` (k,), of ``count`` in all."""
        rows = sp.csr_array(sp.eye_array(count, format="csr")[ids])
        return cls(rows, targets, np.full(len(ids), weight))

    @classmethod
    def join(cls, parts: list[Guides]) -> Guides:
        """Return the springs of all parts."""
        return cls(
            sp.csr_array(sp.vstack([part.rows for part in parts])),
            np.vstack([part.targets for part in parts]),
            np.concatenate([part.weights for part in parts]),
        )

    def energy(self, x: Floats) -> tuple[float, Floats]:
        """Return the springs' energy and its gradient (p, 3)."""
        away = self.rows @ x - self.targets
        pull = self.weights[:, None] * away
        return float(np.sum(pull * away)), 2.0 * (self.rows.T @ pull)


def relax(x: Floats, tets: Ints, guides: Guides) -> Floats:
    """Return the vertices (p, 3) of least energy, from the start ``x`` (p, 3) in mm.

    Raises :class:`SolveError` (``mesh.inverted``) if a tet stays inverted.
    """
    stiffness = np.full(len(tets), RELAXATION.stiffness)
    if volumes(x, tets).min() <= 0:
        x = _minimise(x, tets, guides, stiffness, RELAXATION.untangling, RELAXATION.iterations)
    x = _minimise(x, tets, guides, stiffness, RELAXATION.smoothing, RELAXATION.iterations)
    for _ in range(RELAXATION.rounds):
        bad = (dihedral_angles(x, tets).min(axis=1) < RELAXATION.wanted_deg) | (
            volumes(x, tets) <= 0
        )
        if not bad.any():
            break
        stiffness[bad] *= RELAXATION.stiffening
        x = _minimise(x, tets, guides, stiffness, RELAXATION.smoothing, RELAXATION.later_iterations)
    inverted = np.flatnonzero(volumes(x, tets) <= 0)
    if len(inverted):
        reason = f"{len(inverted)} tetrahedra stay inverted"
        raise SolveError("mesh.inverted", reason, tets=inverted[:10].tolist())
    return x


def _minimise(
    x: Floats, tets: Ints, guides: Guides, stiffness: Floats, smoothing: float, iterations: int
) -> Floats:
    unit = float(np.mean(np.abs(volumes(x, tets)))) ** (1 / 3)

    def energy(flat: Floats) -> tuple[float, Floats]:
        pose = flat.reshape(x.shape)
        gradient = np.zeros(x.shape)
        value = _shape_energy(pose / unit, tets, stiffness, smoothing, gradient)
        pull, force = guides.energy(pose)
        return value + pull, (gradient / unit + force).ravel()

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20, "ftol": 1e-9}
    # On several threads sums are added up in another order, and the last bits differ.
    with threadpool_limits(1):
        solution = minimize(energy, x.ravel(), jac=True, method="L-BFGS-B", options=options)
    return np.asarray(solution.x).reshape(x.shape)


@nb.njit(cache=True, error_model="numpy")
def _shape_energy(
    x: Floats, tets: Ints, stiffness: Floats, smoothing: float, gradient: Floats
) -> float:
    """Return sum c q^4 and add its derivative by ``x`` (p, 3) to ``gradient`` (p, 3)."""
    total = 0.0
    F = np.empty((3, 3))
    C = np.empty((3, 3))
    for t in range(len(tets)):
        tet = tets[t]
        for i in range(3):
            for j in range(3):
                F[i, j] = 0.0
                for k in range(3):
                    F[i, j] += (x[tet[k + 1], i] - x[tet[0], i]) * _INVERSE[k, j]
        square = 0.0
        for i in range(3):
            a = (i + 1) % 3
            b = (i + 2) % 3
            for j in range(3):
                c = (j + 1) % 3
                d = (j + 2) % 3
                C[i, j] = F[a, c] * F[b, d] - F[a, d] * F[b, c]
                square += F[i, j] * F[i, j]
        det = F[0, 0] * C[0, 0] + F[0, 1] * C[0, 1] + F[0, 2] * C[0, 2]
        root = math.sqrt(det * det + smoothing * smoothing)
        chi = 0.5 * (det + root)
        if chi <= 0.0:
            return math.inf
        power = chi ** (-2.0 / 3.0) / 3.0
        q = square * power
        total += stiffness[t] * q**POWER
        outer = stiffness[t] * POWER * q ** (POWER - 1.0)
        by_square = outer * 2.0 * power
        by_det = -outer * (2.0 / 3.0) * q / chi * 0.5 * (1.0 + det / root)
        for k in range(3):
            for i in range(3):
                slope = 0.0
                for j in range(3):
                    slope += (by_square * F[i, j] + by_det * C[i, j]) * _INVERSE[k, j]
                gradient[tet[k + 1], i] += slope
                gradient[tet[0], i] -= slope
    return total


@dataclass(frozen=True)
class TransferOptions:
    """Fineness of the warp between two skins, and the room it leaves over bones."""

    correspondences: int = 900  # flesh vertices spread over the skin that the warp goes through
    smoothing_mm: float = 2.0  # misses that it is allowed, for less bending
    clearance_mm: float = 1.9  # bones stay this deep under the skin where they do in the template
    clearance_steps: int = 8
    least_deg: float = 5.0  # a mesh with a smaller dihedral angle is of no use
    # Weights of the springs on a mesh of flesh, 1/mm^2: of a skin vertex on the face, of one
    # elsewhere, of a vertex on a bone or cut plane, and of every one to where it starts, so that
    # nothing drifts that is not pulled.
    face_pull: float = 20.0
    skin_pull: float = 4.0
    bone_pull: float = 10.0
    stay_pull: float = 0.1


TRANSFER = TransferOptions()


def skin_warp(template: Template, neutral: Floats) -> Warp:
    """Return the smooth map of space from the template's head to the one with skin ``neutral``."""
    flesh = np.unique(template.flesh.faces)
    source = template.skin.vertices
    chosen = flesh[spread(source[flesh], TRANSFER.correspondences)]
    return interpolate(source[chosen], neutral[chosen], TRANSFER.smoothing_mm)


def carry(template: Template, neutral: Floats, warp: Warp) -> Template:
    """Return the anatomy of the person with skin ``neutral`` (n, 3), without shapes and tets.

    ``warp`` is the person's :func:`skin_warp`. The cut planes move outwards where the face
    reaches further than the template's.
    """
    source = template.skin.vertices
    skins = list(zip(_skin_depths(template, source), _skin_depths(template, neutral), strict=True))

    def bone(surface: Surface) -> Surface:
        return surface.with_vertices(_deep_enough(surface.vertices, warp, skins))

    face = template.face_vertices
    reach = neutral[face].min(axis=0) - source[face].min(axis=0)
    return replace(
        template,
        skin=template.skin.with_vertices(neutral),
        parting=warp(source + template.parting) - warp(source),
        cranium=bone(template.cranium),
        mandible=bone(template.mandible),
        muscles=tuple(carry_muscle(muscle, warp) for muscle in template.muscles),
        condyles=warp(template.condyles),
        back_z=template.back_z + min(0.0, float(reach[2])),
        bottom_y=template.bottom_y + min(0.0, float(reach[1])),
        shapes=None,
        mesh=None,
    )


def carry_muscle(muscle: Muscle, motion: Callable[[Floats], Floats]) -> Muscle:
    """Return a muscle whose points have all been moved by ``motion``, (n, 3) -> (n, 3)."""
    middle = (muscle.origin + muscle.insertion) / 2
    half = muscle.fibre * np.linalg.norm(muscle.insertion - muscle.origin) / 2
    points = np.stack([muscle.origin, muscle.insertion, middle - half, middle + half])
    origin, insertion, start, end = motion(points)
    return replace(
        muscle,
        surface=muscle.surface.with_vertices(motion(muscle.surface.vertices)),
        fibre=(end - start) / np.linalg.norm(end - start),
        origin=origin,
        insertion=insertion,
    )


def _skin_depths(template: Template, skin: Floats) -> tuple[SkinDepth, SkinDepth]:
    """Return depths under all ``skin`` (n, 3) of the flesh, and under the face's."""
    flesh = template.flesh.with_vertices(skin)
    on_face = np.isin(flesh.faces, template.face_vertices).all(axis=1)
    return SkinDepth(flesh), SkinDepth(flesh, flesh.faces[on_face])


def _deep_enough(points: Floats, warp: Warp, skins: list[tuple[SkinDepth, SkinDepth]]) -> Floats:
    """Return warped ``points`` (n, 3) as deep under the moved skins as they were, or the clearance.

    Between face and lining there may be no room for both; then the face's skin is kept clear.
    """
    moved = warp(points)
    for _ in range(TRANSFER.clearance_steps):
        start = moved
        for before, after in skins:
            least = np.minimum(before(points)[0], TRANSFER.clearance_mm)
            depths, deeper = after(moved)
            # A bone that reaches through the lining of the mouth has no depth to keep.
            missing = np.where(least > 0, np.maximum(least - depths, 0.0), 0.0)
            moved = moved + missing[:, None] * deeper
        if np.array_equal(moved, start):
            break
    return moved


def flesh_motion(
    vertices: Floats, tets: Ints, moved: Floats, warp: Warp
) -> Callable[[Floats], Floats]:
    """Return a smooth warp corrected so that it moves a mesh as it really moved.

    The mesh has ``vertices`` (p, 3), now ``moved`` (p, 3), and ``tets`` (t, 4). Corrections at the
    vertices are interpolated in the tetrahedron around a point, or at the nearest point of the
    mesh's boundary. So muscles stay where S has them.
    """
    corrections = moved - warp(vertices)
    bind = tet_binder(vertices, tets)

    def motion(points: Floats) -> Floats:
        tet, shares = bind(points)
        correction = np.einsum("nk,nkd->nd", shares, corrections[tets[tet]])
        return np.asarray(warp(points) + correction)

    return motion


def guidance(
    head: Template,
    skin: Floats,
    embedded: Ints,
    surface_rows: sp.csr_array,
    held: Ints,
    held_at: Floats,
    start: Floats,
) -> Guides:
    """Return the springs of a mesh with vertices that ``start`` (p, 3).

    The skin vertices ``embedded`` (e,) of a head follow the mesh by ``surface_rows`` (e, p), and
    should be where ``skin`` (n, 3) has them; the vertices ``held`` (h,) on bones and cut planes
    belong to ``held_at`` (h, 3).
    """
    count = len(start)
    pull = np.where(np.isin(embedded, head.face_vertices), TRANSFER.face_pull, TRANSFER.skin_pull)
    to_skin = Guides(surface_rows, skin[embedded], pull)
    to_bones = Guides.of_vertices(held, held_at, TRANSFER.bone_pull, count)
    to_start = Guides.of_vertices(np.arange(count), start, TRANSFER.stay_pull, count)
    return Guides.join([to_skin, to_bones, to_start])


# A template's tetrahedra carried into a person: the same tets, muscles and S for everybody.
#
# The skin's warp carries all vertices; then the mesh is relaxed, pulled by the person's skin
# through its embedding and by the person's bones through the places it has on the template's.


def transport(
    template: Template, mesh: TemplateMesh, person: Template, warp: Warp
) -> tuple[TemplateMesh, Template]:
    """Return the template's mesh in a person, and the person with muscles moved as their tets are.

    ``mesh`` was made for ``template``, which ``warp``, the map of space between their skins,
    carried into ``person``. Raises :class:`SolveError`: ``mesh.inverted``, or ``mesh.flat`` for a
    tet with a dihedral angle below the least of :data:`TRANSFER`.
    """
    start = warp(mesh.vertices)
    place = start.copy()
    for ids, before, after in (
        (mesh.cranium, template.cranium, person.cranium),
        (mesh.mandible, template.mandible, person.mandible),
    ):
        points = mesh.vertices[ids]
        place[ids] = points + at_nearest(points, before, after.vertices - before.vertices)
    held = np.concatenate([mesh.cranium, mesh.mandible, mesh.cut])
    guides = guidance(
        person, person.skin.vertices, mesh.embedded, mesh.surface_rows, held, place[held], start
    )
    moved = relax(start, mesh.tets, guides)
    narrow = dihedral_angles(moved, mesh.tets).min()
    if narrow < TRANSFER.least_deg:
        reason = f"a tetrahedron is left with a dihedral angle of {narrow:.1f} degrees"
        raise SolveError("mesh.flat", reason, degrees=float(narrow))
    motion = flesh_motion(mesh.vertices, mesh.tets, moved, warp)
    muscles = tuple(carry_muscle(muscle, motion) for muscle in template.muscles)
    return replace(mesh, vertices=moved), replace(person, muscles=muscles)
