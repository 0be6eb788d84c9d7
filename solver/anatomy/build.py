"""Build a subject model from a template and a neutral scan, its muscles divided if wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import igl
import numpy as np
import scipy.sparse as sp
import structlog
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.anatomy.bones import gliding, jaw_frame
from solver.anatomy.embedding import barycentric
from solver.anatomy.meshing import EDGE_MM, make_mesh
from solver.anatomy.muscle_weights import enclosed_volume, fibre_directions, muscle_volumes
from solver.anatomy.template import Cut, Muscle, Template, TemplateMesh
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.anatomy.transfer import carry, skin_warp, transport
from solver.errors import InputError, SolveError
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.jaw_tracks import JawTracks, tracks_of_shapes
from solver.model import CondyleTracks, Expressions, JawFrame, SubjectModel, lower_teeth
from solver.progress import ProgressCallback, Step, silent
from solver.similarity import fit_similarity
from solver.surface import Floats, Ints, Surface, join_surfaces, own_numbers, part_of, unit_rows

log = structlog.get_logger(__name__)


def build_subject_model(
    template: Template,
    neutral: Floats,
    *,
    edge_mm: float = EDGE_MM,
    compartments: bool = False,
    progress: ProgressCallback = silent,
) -> SubjectModel:
    """Return the tetrahedral face of the person with the neutral scan ``neutral`` (n, 3) in mm.

    The template's own tets are carried into the person. Only where it has none of ``edge_mm``, or
    where they cannot be carried, the person is meshed from scratch; ``model.mesh_source`` says so.

    ``neutral`` is the registered neutral scan: the template's skin vertices in the person.
    ``edge_mm`` is the tets' edge length on the face (:func:`make_mesh`). With ``compartments``
    muscles are divided as the template says. ``progress`` is told about the phases ``transfer``,
    ``transport`` or ``mesh``, ``relax`` and ``muscles``.

    Raises :class:`InputError`, ``scan.vertex_count`` or ``scan.nan``, and as :func:`make_mesh`.
    """
    _check(template, neutral)
    person, made_by = carry_anatomy(template, neutral, edge_mm=edge_mm, progress=progress)
    # on the template's own tets: who has them has the same facial spaces and compartments
    shared = person if made_by != "transport" else template
    model = _glide(_assemble(template, person, made_by), shared)
    return _divide(model, shared) if compartments else model


def carry_anatomy(
    template: Template,
    neutral: Floats,
    *,
    edge_mm: float = EDGE_MM,
    progress: ProgressCallback = silent,
) -> tuple[Template, str]:
    """Return the template in the person with skin ``neutral`` (n, 3), and what made its tets."""
    progress(Step("transfer", 0.0))
    warp = skin_warp(template, neutral)
    person = carry(template, neutral, warp)
    made_by = "mesher"
    if template.mesh is not None and template.mesh.edge_mm == edge_mm:
        progress(Step("transport", 0.2))
        try:
            mesh, person = transport(template, template.mesh, person, warp)
            made_by = "transport"
        except SolveError as error:
            log.warning("the template's tets cannot be carried", reason=str(error))
            made_by = f"mesher, since transport failed: {error}"
    if made_by != "transport":
        mesh = make_mesh(person, edge_mm, progress)
    return replace(person, mesh=mesh), made_by


def _assemble(template: Template, person: Template, made_by: str) -> SubjectModel:
    mesh = cast(TemplateMesh, person.mesh)
    skin = person.skin.vertices
    embedding = mesh.embedding(skin)
    return SubjectModel(
        rest=mesh.vertices,
        tets=mesh.tets,
        cranium=mesh.cranium,
        mandible=mesh.mandible,
        cut=mesh.cut,
        sliding=mesh.cranium[:0],
        muscle_names=tuple(muscle.name for muscle in person.muscles),
        weights=mesh.weights,
        skin=person.skin,
        embedded=mesh.embedded,
        embedding=embedding,
        offset=skin[mesh.embedded] - embedding @ mesh.vertices,
        attached_mandible=mesh.attached_mandible,
        face=person.face_vertices,
        jaw=_with_tracks(jaw_frame(person.condyles), template, person.skin.vertices),
        muscles={muscle.name: muscle.surface for muscle in person.muscles},
        bones={"cranium": person.cranium, "mandible": person.mandible},
        regions=person.regions,
        template={"name": template.name, "version": template.version, "sha256": template.sha256},
        mesh_source=made_by,
        fibres=fibre_directions(mesh.vertices, mesh.tets, mesh.weights, person.muscles),
        expressions=_expressions(template),
        trained=mesh.trained,
    )


def _expressions(template: Template) -> Expressions | None:
    shapes = template.shapes
    if shapes is None or not len(shapes.expressions):
        return None
    motions = shapes.expressions[:, template.face_vertices].astype(np.float32)
    return Expressions(shapes.expression_names, motions)


def _glide(model: SubjectModel, source: Template) -> SubjectModel:
    """Return a model held by its cranium with flesh that glides in the spaces of ``source``."""
    mesh = cast(TemplateMesh, source.mesh)
    glides = gliding(source, mesh.vertices[mesh.cranium])
    return replace(model, cranium=mesh.cranium[~glides], sliding=mesh.cranium[glides])


def _divide(model: SubjectModel, source: Template) -> SubjectModel:
    """Return a model of whole muscles with their compartments on the tets of ``source``."""
    mesh = cast(TemplateMesh, source.mesh)
    muscles = source.muscles
    shape = mesh.vertices, mesh.tets, mesh.weights
    numbers = number_compartments(
        *shape, fibre_directions(*shape, muscles), muscles, float(source.condyles[:, 0].mean())
    )
    divided = divide_muscles(model.weights, muscles, numbers)
    return replace(
        model, weights=divided.weights, muscle_names=divided.names, wholes=divided.wholes
    )


def jaw_tracks(template: Template, model: SubjectModel) -> JawTracks:
    """Return the tracks of a person's jaw: those of the template's shapes, in the person's size.

    They keep their slope against the frame of the condyles, and grow with the head.
    """
    return _tracks(template, model.jaw, model.skin.vertices)


def _with_tracks(frame: JawFrame, template: Template, neutral: Floats) -> JawFrame:
    found = _tracks(template, frame, neutral)
    sizes = CondyleTracks(found.slope, found.apart, found.length, found.opening)
    return replace(frame, tracks=sizes)


def _tracks(template: Template, frame: JawFrame, neutral: Floats) -> JawTracks:
    skin = template.skin.vertices
    teeth = lower_teeth(template.regions, template.attached_mandible)
    apart = float(np.linalg.norm(template.condyles[0] - template.condyles[1]))
    shapes = [] if template.shapes is None else list(template.shapes.expressions[:, teeth])
    found = tracks_of_shapes(jaw_frame(template.condyles), apart, skin[teeth], shapes)
    size = fit_similarity(skin, neutral).scale
    return replace(
        found, frame=frame, apart=size * apart, length=size * found.length, bend=found.bend / size
    )


def _check(template: Template, neutral: Floats) -> None:
    expected = template.skin.vertices.shape
    if neutral.shape != expected:
        found = len(neutral)
        wanted = expected[0]
        reason = f"the neutral has {found} vertices, the template '{template.name}' has {wanted}"
        raise InputError("scan.vertex_count", reason, expected=wanted, found=found)
    wrong = np.flatnonzero(~np.isfinite(neutral).all(axis=1))
    if len(wrong):
        reason = f"vertex {wrong[0]} of the neutral is not finite"
        raise InputError("scan.nan", reason, vertex=int(wrong[0]))


def model_summary(model: SubjectModel) -> dict[str, Any]:
    """Return figures to judge a model by: counts, angles, embedding error, volumes, clearance.

    ``embedding_*_mm`` is what the embedding leaves to an offset, ``surface_*_mm`` how far the face
    skin lies from the outside of the tets, ``bone_clearance_mm`` how near a bone comes to it.
    """
    skin = model.skin.vertices
    misses = np.linalg.norm(model.offset, axis=1)[np.isin(model.embedded, model.face)]
    outside = Surface(model.rest, igl.boundary_facets(model.tets)[0])
    depth = barycentric(skin[model.face], outside)[2]
    on_face = np.isin(model.skin.faces, model.face).all(axis=1)
    face = part_of(model.skin, np.flatnonzero(on_face))
    clearance = barycentric(join_surfaces(list(model.bones.values())).vertices, face)[2]
    enclosed = {name: enclosed_volume(surface) for name, surface in model.muscles.items()}
    held = muscle_volumes(model.rest, model.tets, model.weights).tolist()
    muscles = dict(zip(model.muscle_names, held, strict=True))
    kept = dict.fromkeys(model.muscle_groups, 0.0)
    for whole, volume in zip(model.muscle_groups, held, strict=True):
        kept[whole] += volume / enclosed[whole]
    sizes = volumes(model.rest, model.tets)
    return {
        "template": model.anatomy,
        "mesh_source": model.mesh_source,
        "size_from": model.size_from,
        "content_sha256": model.sha256,
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "inverted": int(np.sum(sizes <= 0)),
        "smallest_dihedral_deg": float(dihedral_angles(model.rest, model.tets).min()),
        "volume_cm3": float(sizes.sum()) / 1000.0,
        "held": {
            name: len(getattr(model, name)) for name in ("cranium", "mandible", "cut", "sliding")
        },
        "muscles": model.muscle_count,
        "candidates_per_tet": (model.weights.nnz / len(model.tets)) - 1.0,
        "muscle_volume_cm3": {name: round(v / 1000.0, 3) for name, v in muscles.items()},
        "muscle_volume_kept": {name: round(part, 2) for name, part in kept.items()},
        "muscle_volume_enclosed_cm3": {name: round(v / 1000.0, 3) for name, v in enclosed.items()},
        "embedded": len(model.embedded),
        "face_vertices": len(model.face),
        "embedding_mean_mm": float(misses.mean()),
        "embedding_max_mm": float(misses.max()),
        "surface_mean_mm": float(depth.mean()),
        "surface_max_mm": float(depth.max()),
        "bone_clearance_mm": float(clearance.min()),
    }


# Compartments of muscles, which contract on their own: strips or sectors. A face recruits parts of
# its broad muscles. A template's table says which they are and how they lie
# (:class:`solver.anatomy.template.Compartments`); here every candidate of the whole muscle, an
# entry of S, gets the number of one of them. So S divided has the pattern and values of S whole,
# with more columns.
#
# Strips lie between level sets of a function u that hardly changes along the fibres f, and grows
# across them in the direction d of the cut, d' being d square to the fibres, of unit length:
#
#     min int (f . grad u)^2 + slip |grad u - d'|^2 + pull (u - d . x)^2
#
# in linear elements of the muscle's tets. Outwards of a ring d leads from its middle, and |x| from
# there is in the place of d . x.


@dataclass(frozen=True)
class CutOptions:
    """Numbers of the functions that muscles are cut by."""

    slip: float = 0.1  # weight of growing across the fibres, by that of not changing along them
    pull: float = 1e-5  # of keeping to the place, 1/mm^2: pieces of a muscle are not connected
    # A muscle is one of the middle if that lies within this part of its width from its mean.
    middle: float = 0.2


CUTTING = CutOptions()


@dataclass(frozen=True)
class DividedMuscles:
    """S of compartments: its columns, (n, m + 1), with their names and those of their wholes."""

    weights: sp.csr_array
    names: tuple[str, ...]
    wholes: tuple[str, ...]


def divide_muscles(
    weights: sp.csr_array, muscles: tuple[Muscle, ...], numbers: Ints
) -> DividedMuscles:
    """Return S with a column for each compartment; ``numbers`` as :func:`number_compartments`."""
    counts = [len(muscle.compartment_names) for muscle in muscles]
    first = np.concatenate([[0], 1 + np.cumsum([0, *counts])[:-1]])
    # within a row the order of entries stays: compartments take their whole's place
    columns = (first[weights.indices] + numbers).astype(weights.indices.dtype)
    names = tuple(name for muscle in muscles for name in muscle.compartment_names)
    wholes = tuple(muscle.name for muscle in muscles for _ in muscle.compartment_names)
    parts = weights.data, columns, weights.indptr
    divided = sp.csr_array(parts, shape=(weights.shape[0], len(names) + 1))
    return DividedMuscles(divided, names, wholes)


def number_compartments(
    vertices: Floats,
    tets: Ints,
    weights: sp.csr_array,
    fibres: Floats,
    muscles: tuple[Muscle, ...],
    middle_x: float,
) -> Ints:
    """Return for every entry (nnz,) of S the number of its compartment within its muscle.

    ``vertices`` (p, 3) in mm and ``tets`` (n, 4) are at rest, ``weights`` (n, m + 1) and ``fibres``
    (nnz, 3) those of the whole ``muscles``; x is ``middle_x`` between the sides. The compartments
    of a muscle have equal volumes, up to a tet; one is left out where the muscle has fewer tets
    than compartments. Candidates that the muscle does not fill go with the nearest that it does.
    """
    entries = weights.tocoo()
    sizes = volumes(vertices, tets)
    centres = vertices[tets].mean(axis=1)
    numbers = np.zeros(weights.nnz, dtype=np.int64)
    for column, muscle in enumerate(muscles, start=1):
        every = np.flatnonzero(entries.col == column)
        own = every[entries.data[every] > 0.0]
        if muscle.compartments is None or not len(own):
            continue
        rows = entries.row[own]
        places = centres[rows] - [middle_x, 0.0, 0.0]
        flesh = sizes[rows] * entries.data[own]
        part = np.zeros(len(own), dtype=np.int64)
        for each in muscle.compartments.cuts:
            if each.cut == "sectors":
                order = _around(places) if muscle.ring else places @ muscle.fibre
            else:
                length = _outward(places) if each.cut == "lateral" else 1.0
                order = _across(vertices, tets[rows], fibres[own], each.cut, length)
            finer = len(each.names) * part
            for number in np.unique(part):
                mine = part == number
                finer[mine] += _equal_parts(order[mine], flesh[mine], len(each.names))
            part = finer
        numbers[every] = part[cKDTree(centres[rows]).query(centres[entries.row[every]])[1]]
    return numbers


def fibre_laplacian(
    gradients: Floats, sizes: Floats, corners: Ints, fibres: Floats, slip: float
) -> sp.csc_array:
    """Return K (p, p) of u . K u = int (f . grad u)^2 + slip |grad u|^2, for u at p vertices.

    ``gradients`` (k, 4, 3) and ``sizes`` (k,) are those of the tets ``corners`` (k, 4).
    """
    along = np.einsum("evi,ei->ev", gradients, fibres)
    local = along[:, :, None] * along[:, None, :]
    local += slip * gradients @ gradients.transpose(0, 2, 1)
    pairs = np.repeat(corners, 4, axis=1).ravel(), np.tile(corners, 4).ravel()
    return sp.csc_array(((sizes[:, None, None] * local).ravel(), pairs))


def _across(vertices: Floats, tets: Ints, fibres: Floats, cut: Cut, length: float) -> Floats:
    """Return u (k,) in tets (k, 4) of a muscle with unit ``fibres`` (k, 3), in mm.

    ``length`` is that of d, -1 to turn it around.
    """
    gradients, sizes = shape_gradients(vertices, tets)
    used, corners = own_numbers(tets)
    place, direction = _way(vertices[used], corners, cut)
    place = length * place
    direction = length * direction
    K = fibre_laplacian(gradients, sizes, corners, fibres, CUTTING.slip)
    along = (fibres * direction).sum(axis=1, keepdims=True)
    wanted = unit_rows(direction - along * fibres)
    load = CUTTING.slip * sizes[:, None] * np.einsum("evi,ei->ev", gradients, wanted)
    pull = CUTTING.pull * np.bincount(corners.ravel(), np.repeat(sizes / 4.0, 4), len(used))
    right = pull * place + np.bincount(corners.ravel(), load.ravel(), len(used))
    u = splu((K + sp.diags_array(pull)).tocsc()).solve(right)
    return np.asarray(u[corners].mean(axis=1))


def _way(points: Floats, corners: Ints, cut: Cut) -> tuple[Floats, Floats]:
    """Return how far points (p, 3) are the way of a cut, and that way (k, 3) in tets (k, 4)."""
    if cut == "outward":
        arms = points - (points.min(axis=0) + points.max(axis=0)) / 2
        return np.linalg.norm(arms, axis=1), unit_rows(arms[corners].mean(axis=1))
    direction = np.eye(3)[("lateral", "superior", "anterior").index(cut)]
    return points @ direction, np.tile(direction, (len(corners), 1))


def _outward(places: Floats) -> float:
    """Return the sign of x that leads away from the middle; to the left for what lies in it."""
    x = places[:, 0]
    return -1.0 if x.mean() < -CUTTING.middle * np.ptp(x) else 1.0


def _around(places: Floats) -> Floats:
    """Return the angles (k,), in [0, 2 pi), of a ring's places (k, 3) from its top outwards."""
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    axis = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][2]
    up = np.array([0.0, 1.0, 0.0])
    up -= axis * (axis @ up)
    side = np.cross(up, axis)
    side *= _outward(places) * np.sign(side[0])
    return np.asarray(np.arctan2((places - centre) @ side, (places - centre) @ up) % (2.0 * np.pi))


def _equal_parts(values: Floats, sizes: Floats, count: int) -> Ints:
    """Return which of ``count`` parts, of equal sums of sizes (k,), each of the values is in."""
    order = np.argsort(values, kind="stable")
    before = np.cumsum(sizes[order]) - sizes[order] / 2
    parts = np.empty(len(values), dtype=np.int64)
    parts[order] = np.minimum(count * before / sizes.sum(), count - 1).astype(np.int64)
    return parts
