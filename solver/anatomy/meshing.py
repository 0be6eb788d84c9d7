"""Tetrahedra of a head from scratch: the mesh that a template shares with every person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import structlog
from scipy.spatial import cKDTree

from solver.anatomy.domain import (
    DOMAIN,
    Label,
    MeshedFlesh,
    choose_flesh,
    domain_soup,
    edge_lengths,
    in_front,
    label_tets,
)
from solver.anatomy.embedding import at_nearest, bind_outside, rows_of
from solver.anatomy.muscle_weights import initial_weights
from solver.anatomy.template import Template, TemplateMesh
from solver.anatomy.tetrahedra import tetrahedralize
from solver.anatomy.transfer import guidance, relax
from solver.cache import cache_directory
from solver.errors import InputError, SolveError
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.progress import ProgressCallback, Step, silent
from solver.surface import Floats, Ints

EDGE_MM = 9.0  # the usual edge length on the face


@dataclass(frozen=True)
class MeshOptions:
    """Distances that decide how flesh, skin and bones are joined."""

    envelope: float = 0.08  # distance between flesh surface and skin as a part of the edge length
    greatest_envelope_mm: float = 1.6
    # Of processor time; a head at the usual edge length takes one or two minutes.
    mesher_seconds: float = 900.0
    # Within this distance of the mandible a cut plane is free: the jaw's angle moves with it.
    jaw_free_mm: float = 15.0
    # So is one this near to the face under the jaw: the throat is drawn along.
    face_free_mm: float = 20.0
    # Skin further from the flesh than this part of the edge length does not follow it.
    embedding: float = 0.25
    # Skin beyond the flesh goes with the jaw this near to it: the mouth's lining, not the neck.
    lining_mm: float = 8.0
    fitting_rounds: int = 3  # of binding the skin to the mesh and fitting the mesh to the skin


MESH = MeshOptions()


def make_mesh(
    head: Template,
    edge_mm: float = EDGE_MM,
    progress: ProgressCallback = silent,
    mesher_seconds: float = MESH.mesher_seconds,
) -> TemplateMesh:
    """Fill the flesh between a head's skin and bones with tetrahedra (1 to 6 minutes).

    The lips are parted to mesh them, then closed; the mesh is relaxed in both poses. The same head
    gives another mesh every time. ``head`` is anatomy in any neutral, a template's own or one
    carried into a person. ``edge_mm`` is the edge length on the face; lips, eyes and nose are
    finer, neck and scalp coarser. 9 mm gives about 7k vertices and 25k tetrahedra. ``progress`` is
    told about the phases ``mesh``, ``relax`` and ``muscles``.

    Raises :class:`SolveError`: ``mesher.timeout``, ``mesher.crashed``, ``mesh.inverted`` or
    ``mesh.uncovered``.
    """
    progress(Step("mesh", 0.0, message="tetrahedra by fTetWild"))
    flesh = _mesh(head, edge_mm, mesher_seconds)
    progress(Step("relax", 0.85))
    flesh = _fit(head, flesh)
    embedded, tet, shares, jaw_skin = bind_skin(head, flesh, edge_mm)
    lost = np.setdiff1d(head.face_vertices, embedded)
    if len(lost):
        reason = f"{len(lost)} face vertices, the first is {lost[0]}, are too far from the flesh"
        raise SolveError("mesh.uncovered", reason, vertex=int(lost[0]), count=len(lost))
    rows = rows_of(flesh.tets[tet], shares, len(flesh.vertices))
    held = flesh.held_vertices
    start = close_lips(head, flesh.vertices, flesh.tets, flesh.outside, held)
    guides = guidance(head, head.skin.vertices, embedded, rows, held, flesh.vertices[held], start)
    rest = relax(start, flesh.tets, guides)
    cranium, mandible, cut = _held(head, flesh)
    progress(Step("muscles", 0.92))
    weights = initial_weights(rest, flesh.tets, [muscle.surface for muscle in head.muscles])
    progress(Step("muscles", 1.0))
    return TemplateMesh(
        edge_mm=edge_mm,
        vertices=rest,
        tets=flesh.tets,
        cranium=cranium,
        mandible=mandible,
        cut=cut,
        embedded=embedded,
        embedded_in=tet,
        shares=shares,
        attached_mandible=jaw_skin,
        weights=weights,
    )


def _mesh(head: Template, edge_mm: float, mesher_seconds: float) -> MeshedFlesh:
    """Return the flesh in the parted pose, as the mesher leaves it."""
    soup = domain_soup(head)
    vertices, tets = tetrahedralize(
        soup,
        DOMAIN.deep_factor * edge_mm,
        envelope_mm=min(MESH.envelope * edge_mm, MESH.greatest_envelope_mm),
        lengths=edge_lengths(head, soup, edge_mm),
        cpu_seconds=mesher_seconds,
    )
    return choose_flesh(vertices, tets, label_tets(head, vertices, tets))


def _fit(head: Template, flesh: MeshedFlesh) -> MeshedFlesh:
    """Return the flesh with its vertices fitted to the parted skin in least squares."""
    skin = np.unique(head.flesh.faces)
    parted = head.parted_skin.vertices
    for _ in range(MESH.fitting_rounds):
        tet, shares, distance = _bound(flesh, parted[skin])
        near = distance < MESH.greatest_envelope_mm
        rows = rows_of(flesh.tets[tet], shares, len(flesh.vertices))[near]
        held = flesh.held_vertices
        place = _on_bones(head, flesh)
        guides = guidance(head, parted, skin[near], rows, held, place[held], flesh.vertices)
        flesh = replace(flesh, vertices=relax(flesh.vertices, flesh.tets, guides))
    return flesh


def _on_bones(head: Template, flesh: MeshedFlesh) -> Floats:
    """Return the flesh's vertices (p, 3), those on a bone moved to its nearest point."""
    place = flesh.vertices.copy()
    for label, bone in ((Label.CRANIUM, head.cranium), (Label.MANDIBLE, head.mandible)):
        ids = flesh.held[label]
        place[ids] = at_nearest(flesh.vertices[ids], bone, bone.vertices)
    return place


def _bound(flesh: MeshedFlesh, points: Floats) -> tuple[Ints, Floats, Floats]:
    """Return the nearest outer tets (n,), coordinates (n, 4) in them and the distance (n,)."""
    return bind_outside(points, flesh.vertices, flesh.tets, flesh.outside, flesh.outside_of)


def bind_skin(
    head: Template, flesh: MeshedFlesh, edge_mm: float
) -> tuple[Ints, Ints, Floats, Ints]:
    """Return skin vertices that follow the flesh, their tets and coordinates, and the jaw's skin.

    Vertices are bound in the parted pose: there the upper lip is far from the lower.
    """
    skin = np.unique(head.flesh.faces)
    parted = head.parted_skin.vertices[skin]
    (tet, shares, distance), ahead = _bound(flesh, parted), in_front(head, parted)
    near = (distance < MESH.embedding * edge_mm) & ahead
    loose = ~near & ahead
    to_jaw = cKDTree(head.mandible.vertices).query(parted[loose])[0]
    to_skull = cKDTree(head.cranium.vertices).query(parted[loose])[0]
    lining = (to_jaw < to_skull) & (to_jaw < MESH.lining_mm)
    jaw_skin = np.union1d(head.attached_mandible, skin[loose][lining])
    return skin[near], tet[near], shares[near], jaw_skin


def _held(head: Template, flesh: MeshedFlesh) -> tuple[Ints, Ints, Ints]:
    """Return the vertices on cranium, mandible and cut planes; those on two are the mandible's."""
    mandible = flesh.held[Label.MANDIBLE]
    cranium = np.setdiff1d(flesh.held[Label.CRANIUM], mandible)
    cut = np.setdiff1d(flesh.held[Label.CUT], np.union1d(mandible, cranium))
    cut = cut[~_drawn_along(head, flesh.vertices[cut])]
    return cranium, mandible, cut


def _drawn_along(head: Template, points: Floats) -> np.ndarray:
    """Return (n,) True for points of a cut plane that move with jaw or face."""
    jaw = head.mandible.vertices
    face = head.skin.vertices[head.face_vertices]
    near_jaw, near_face = (cKDTree(part).query(points)[0] for part in (jaw, face))
    in_throat = (points[:, 1] < jaw[:, 1].min()) & (near_face < MESH.face_free_mm)
    return np.asarray((near_jaw < MESH.jaw_free_mm) | in_throat)


def close_lips(head: Template, vertices: Floats, tets: Ints, outside: Ints, held: Ints) -> Floats:
    """Return the flesh's vertices (p, 3), meshed with parted lips, with the lips closed.

    Vertices of the ``outside`` faces (f, 3) move with the skin they lie on, ``held`` ones stay
    and the others follow harmonically; tets between the lips may come out inverted.
    """
    skin_side = np.setdiff1d(outside, held)
    displacement = at_nearest(vertices[skin_side], head.parted_flesh, -head.parting)
    known = np.concatenate([skin_side, held])
    values = np.vstack([displacement, np.zeros((len(held), 3))])
    return vertices + harmonic_displacement(vertices, tets, known, values)


def harmonic_displacement(vertices: Floats, tets: Ints, known: Ints, values: Floats) -> Floats:
    """Return the displacement (p, 3) that is ``values`` (k, 3) at ``known`` (k,) and harmonic.

    Linear finite elements; the vertices (p, 3) give the metric.
    """
    displacement = np.zeros_like(vertices)
    displacement[known] = values
    given = np.zeros(len(vertices), dtype=bool)
    given[known] = True
    gradients, sizes = shape_gradients(vertices, tets)
    return HarmonicExtension(laplacian(gradients, sizes, tets, len(vertices)), given)(displacement)


# A template's tets where its file carries none of the wanted size: made once, then kept.

MAKING = 4  # part of the name in the cache; counts up where meshes are made in another way

log = structlog.get_logger(__name__)


def find_or_make_mesh(
    template: Template,
    edge_mm: float = EDGE_MM,
    progress: ProgressCallback = silent,
    mesher_seconds: float = MESH.mesher_seconds,
) -> Template:
    """Return the template with tets of ``edge_mm``: its own, those in the cache, or new ones.

    New ones take minutes and are not reproducible, so they are kept in the cache folder under the
    hash of what they were made from, and read only if that is what they were made from. Fine ones
    take longer than the usual ``mesher_seconds``. Raises as :func:`make_mesh`.
    """
    own = template.mesh
    if own is not None and own.edge_mm == edge_mm:
        return template
    bare = replace(template.without_compartments, mesh=None)
    path = cache_directory() / f"meshed-{MAKING}-{bare.sha256[:16]}-{edge_mm:g}mm.npz"
    if (kept := _read_kept(path, bare, edge_mm)) is not None:
        return replace(template, mesh=_trained_by(own, kept))
    log.info("making the template's tets", template=template.name, to=str(path))
    made = make_mesh(bare, edge_mm, progress, mesher_seconds)
    if not path.exists():  # else another process was faster: then its tets are everybody's
        replace(bare, mesh=made).save(path)
    made = cast(TemplateMesh, Template.load(path).mesh)
    return replace(template, mesh=_trained_by(own, made))


def _trained_by(own: TemplateMesh | None, made: TemplateMesh) -> TemplateMesh:
    """Return ``made`` tets with the training of a template's own ones."""
    return made if own is None else replace(made, trained=made.trained_like(own))


def _read_kept(path: Path, bare: Template, edge_mm: float) -> TemplateMesh | None:
    """Return tets from the cache; None: they are not there, or not those that are wanted."""
    if not path.exists():
        return None
    try:
        found = Template.load(path)
        same = replace(found, mesh=None).sha256 == bare.sha256
        if same and found.mesh is not None and found.mesh.edge_mm == edge_mm:
            return found.mesh
        reason = "they are of another template or size"
    except InputError as error:
        reason = str(error)
    log.warning("the template's tets are made anew", reason=reason)
    path.unlink(missing_ok=True)
    return None
