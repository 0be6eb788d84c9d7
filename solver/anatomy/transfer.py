"""Carrying a template's anatomy into a person whose neutral scan has the template's topology."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import igl
import numpy as np
import scipy.sparse as sp

from solver.anatomy.depth_warp import SkinDepth
from solver.anatomy.domain import boundary
from solver.anatomy.embedding import barycentric
from solver.anatomy.relaxation import Guides, relax
from solver.anatomy.template import Muscle, Template, TemplateMesh
from solver.anatomy.tetrahedra import barycentric_in_tets, dihedral_angles
from solver.anatomy.warp import Warp, interpolate, spread
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


def skin_warp(template: Template, neutral: Floats, options: TransferOptions = TRANSFER) -> Warp:
    """Return the smooth map of space from the template's head to the one with skin ``neutral``."""
    flesh = np.unique(template.skin.faces[template.flesh_faces])
    source = template.skin.vertices
    chosen = flesh[spread(source[flesh], options.correspondences)]
    return interpolate(source[chosen], neutral[chosen], options.smoothing_mm)


def carry(
    template: Template, neutral: Floats, warp: Warp, options: TransferOptions = TRANSFER
) -> Template:
    """Return the anatomy of the person with skin ``neutral`` (n, 3), without shapes and tets.

    ``warp`` is the person's :func:`skin_warp`. The cut planes move outwards where the face
    reaches further than the template's.
    """
    source = template.skin.vertices
    before, after = _Depths(template, source), _Depths(template, neutral)

    def bone(surface: Surface) -> Surface:
        start = warp(surface.vertices)
        return surface.moved(_deep_enough(surface.vertices, start, before, after, options))

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


class _Depths:
    """Depths of points under all skin of the flesh, and under the face's."""

    def __init__(self, template: Template, skin: Floats) -> None:
        flesh = template.skin.faces[template.flesh_faces]
        on_face = np.isin(flesh, template.face_vertices).all(axis=1)
        self.flesh = SkinDepth(Surface(skin, flesh))
        self.face = SkinDepth(Surface(skin, flesh), flesh[on_face])


def _deep_enough(
    points: Floats, moved: Floats, before: _Depths, after: _Depths, options: TransferOptions
) -> Floats:
    """Return ``moved`` (n, 3) pushed as deep as ``points`` (n, 3), or the wanted clearance.

    Between face and lining there may be no room for both; then the face's skin is kept clear.
    """
    for _ in range(options.clearance_steps):
        start = moved
        for skin_before, skin_after in ((before.flesh, after.flesh), (before.face, after.face)):
            least = np.minimum(skin_before(points)[0], options.clearance_mm)
            depths, deeper = skin_after(moved)
            # A bone that reaches through the lining of the mouth has no depth to keep.
            missing = np.where(least > 0, np.maximum(least - depths, 0.0), 0.0)
            moved = moved + missing[:, None] * deeper
        if np.array_equal(moved, start):
            break
    return moved


# Motion of all points of the flesh when its tetrahedra move.


class FleshMotion:
    """A smooth warp corrected so that it moves a mesh's vertices as they really moved.

    The corrections at the vertices are interpolated in the tetrahedron around a point, or at the
    nearest point of the mesh's boundary. So muscles stay where S has them.
    """

    def __init__(self, vertices: Floats, tets: Ints, moved: Floats, warp: Warp) -> None:
        """Take a mesh, ``vertices`` (p, 3) and ``tets`` (t, 4), and where it ``moved``, (p, 3)."""
        self._vertices, self._tets, self._warp = vertices, tets, warp
        self._surface = Surface(vertices, boundary(tets))
        self._correction = moved - warp(vertices)
        self._tree = igl.AABB()
        self._tree.init(vertices, tets)

    def __call__(self, points: Floats) -> Floats:
        """Return the images (n, 3) of ``points`` (n, 3)."""
        points = np.ascontiguousarray(points)
        tet = np.asarray(igl.in_element(self._vertices, self._tets, points, self._tree))
        correction = np.empty_like(points)
        inside, outside = np.flatnonzero(tet >= 0), np.flatnonzero(tet < 0)
        corners = self._tets[tet[inside]]
        shares = barycentric_in_tets(points[inside], self._vertices[corners])
        correction[inside] = np.einsum("nk,nkd->nd", shares, self._correction[corners])
        if len(outside):
            face, shares, _ = barycentric(points[outside], self._surface)
            corners = self._surface.faces[face]
            correction[outside] = np.einsum("nk,nkd->nd", shares, self._correction[corners])
        return self._warp(points) + correction


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
    pulls: Pulls = PULLS,
) -> Guides:
    """Return the springs of a mesh.

    Parameters
    ----------
    head
        Says which skin vertices are the face's.
    skin
        (n, 3) positions the skin should have.
    embedded, surface_rows
        (e,) skin vertices that follow the mesh, and the (e, p) rows of their surface points.
    held, held_at
        (h,) vertices on bones and cut planes, and where they belong, (h, 3).
    start
        (p, 3) positions of all vertices.
    pulls
        Weights of the springs.
    """
    count = len(start)
    pull = np.where(np.isin(embedded, head.face_vertices), pulls.face, pulls.skin)
    return Guides.join(
        [
            Guides(surface_rows, skin[embedded], pull),
            Guides.of_vertices(held, held_at, pulls.bone, count),
            Guides.of_vertices(np.arange(count), start, pulls.stay, count),
        ]
    )


# A template's tetrahedra carried into a person: the same tets, muscles and S for everybody.
#
# The skin's warp carries all vertices; then the mesh is relaxed, pulled by the person's skin
# through its embedding and by the person's bones through the places it has on the template's.


def transport(
    template: Template,
    mesh: TemplateMesh,
    person: Template,
    warp: Warp,
    options: TransferOptions = TRANSFER,
) -> tuple[TemplateMesh, Template]:
    """Return the template's mesh in a person, and the person with muscles moved as their tets are.

    Parameters
    ----------
    template
        The head the mesh was made for.
    mesh
        The template's tets.
    person
        The template carried into the person by ``warp``.
    warp
        The map of space between their skins.
    options
        Of these, the least dihedral angle.

    Raises
    ------
    SolveError
        ``mesh.inverted`` or ``mesh.flat``.
    """
    start = warp(mesh.vertices)
    place = start.copy()
    cranium = np.concatenate([mesh.cranium, mesh.sliding])
    for ids, before, after in (
        (cranium, template.cranium, person.cranium),
        (mesh.mandible, template.mandible, person.mandible),
    ):
        place[ids] = _follow(mesh.vertices[ids], before, after)
    held = np.concatenate([cranium, mesh.mandible, mesh.cut])
    guides = guidance(
        person, person.skin.vertices, mesh.embedded, mesh.surface_rows, held, place[held], start
    )
    moved = relax(start, mesh.tets, guides)
    narrow = dihedral_angles(moved, mesh.tets).min()
    if narrow < options.least_deg:
        raise SolveError(
            "mesh.flat",
            f"a tetrahedron is left with a dihedral angle of {narrow:.1f} degrees",
            degrees=float(narrow),
        )
    motion = FleshMotion(mesh.vertices, mesh.tets, moved, warp)
    muscles = tuple(carry_muscle(muscle, motion) for muscle in template.muscles)
    return replace(mesh, vertices=moved), replace(person, muscles=muscles)


def _follow(points: Floats, before: Surface, after: Surface) -> Floats:
    """Return where points (n, 3) near a surface go when it moves."""
    face, shares, _ = barycentric(points, before)
    moved = (after.vertices - before.vertices)[before.faces[face]]
    return np.asarray(points + np.einsum("nk,nkd->nd", shares, moved))
