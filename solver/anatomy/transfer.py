"""Carrying a template's anatomy into a person whose neutral scan has the template's topology."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import at_nearest, tet_binder
from solver.anatomy.relaxation import Guides, relax
from solver.anatomy.template import Muscle, Template, TemplateMesh
from solver.anatomy.tetrahedra import dihedral_angles
from solver.anatomy.warp import SkinDepth, Warp, interpolate, spread
from solver.errors import SolveError
from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class TransferOptions:
    """Fineness of the warp between two skins, and the room it leaves over bones."""

    correspondences: int = 900  # flesh vertices spread over the skin that the warp goes through
    smoothing_mm: float = 2.0  # misses that it is allowed, for less bending
    clearance_mm: float = 1.9  # bones stay this deep under the skin where they do in the template
    clearance_steps: int = 8
    least_deg: float = 5.0  # a mesh with a smaller dihedral angle is of no use


TRANSFER = TransferOptions()


def skin_warp(template: Template, neutral: Floats) -> Warp:
    """Return the smooth map of space from the template's head to the one with skin ``neutral``."""
    flesh, source = np.unique(template.flesh.faces), template.skin.vertices
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
        return surface.moved(_deep_enough(surface.vertices, warp, skins))

    face = template.face_vertices
    reach = neutral[face].min(axis=0) - source[face].min(axis=0)
    return replace(
        template,
        skin=template.skin.moved(neutral),
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
        surface=muscle.surface.moved(motion(muscle.surface.vertices)),
        fibre=(end - start) / np.linalg.norm(end - start),
        origin=origin,
        insertion=insertion,
    )


def _skin_depths(template: Template, skin: Floats) -> tuple[SkinDepth, SkinDepth]:
    """Return depths under all ``skin`` (n, 3) of the flesh, and under the face's."""
    flesh = template.flesh.moved(skin)
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


# Motion of all points of the flesh when its tetrahedra move.


def flesh_motion(
    vertices: Floats, tets: Ints, moved: Floats, warp: Warp
) -> Callable[[Floats], Floats]:
    """Return a smooth warp corrected so that it moves a mesh as it really moved.

    The mesh has ``vertices`` (p, 3), now ``moved`` (p, 3), and ``tets`` (t, 4). Corrections at the
    vertices are interpolated in the tetrahedron around a point, or at the nearest point of the
    mesh's boundary. So muscles stay where S has them.
    """
    corrections, bind = moved - warp(vertices), tet_binder(vertices, tets)

    def motion(points: Floats) -> Floats:
        tet, shares = bind(points)
        correction = np.einsum("nk,nkd->nd", shares, corrections[tets[tet]])
        return np.asarray(warp(points) + correction)

    return motion


# Springs on a mesh of flesh: from the skin it carries, the bones it lies on, and its place.


@dataclass(frozen=True)
class Pulls:
    """Weights of springs, 1/mm^2."""

    face: float = 20.0  # of a skin vertex on the face
    skin: float = 4.0  # of one elsewhere
    bone: float = 10.0  # of a vertex on a bone or cut plane
    # Of every vertex to where it starts, so that nothing drifts that is not pulled.
    stay: float = 0.1


PULLS = Pulls()


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
    pull = np.where(np.isin(embedded, head.face_vertices), PULLS.face, PULLS.skin)
    to_skin = Guides(surface_rows, skin[embedded], pull)
    to_bones = Guides.of_vertices(held, held_at, PULLS.bone, count)
    to_start = Guides.of_vertices(np.arange(count), start, PULLS.stay, count)
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
