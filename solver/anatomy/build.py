"""From a template and a neutral scan to a subject model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import igl
import numpy as np
import structlog

from solver.anatomy.bones import gliding, jaw_frame
from solver.anatomy.compartments import divide_muscles, number_compartments
from solver.anatomy.embedding import barycentric
from solver.anatomy.meshing import EDGE_MM, make_mesh
from solver.anatomy.muscle_weights import enclosed_volume, fibre_directions, muscle_volumes
from solver.anatomy.template import Template, TemplateMesh
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.anatomy.transfer import carry, skin_warp, transport
from solver.errors import InputError, SolveError
from solver.mechanics.jaw_tracks import TRACKS, JawTracks, TrackOptions, tracks_of_shapes
from solver.model import CondyleTracks, JawFrame, SubjectModel, lower_teeth
from solver.progress import Progress, Step, silent
from solver.similarity import fit_similarity
from solver.surface import Floats, Surface, join_surfaces, part_of

log = structlog.get_logger(__name__)


def build_subject_model(
    template: Template,
    neutral: Floats,
    *,
    edge_mm: float = EDGE_MM,
    compartments: bool = False,
    progress: Progress = silent,
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
    template: Template, neutral: Floats, *, edge_mm: float = EDGE_MM, progress: Progress = silent
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
    mesh, skin = cast(TemplateMesh, person.mesh), person.skin.vertices
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
    )


def _glide(model: SubjectModel, source: Template) -> SubjectModel:
    """Return a model held by its cranium with flesh that glides in the spaces of ``source``."""
    mesh = cast(TemplateMesh, source.mesh)
    glides = gliding(source, mesh.vertices[mesh.cranium])
    return replace(model, cranium=mesh.cranium[~glides], sliding=mesh.cranium[glides])


def _divide(model: SubjectModel, source: Template) -> SubjectModel:
    """Return a model of whole muscles with their compartments on the tets of ``source``."""
    mesh, muscles = cast(TemplateMesh, source.mesh), source.muscles
    shape = mesh.vertices, mesh.tets, mesh.weights
    numbers = number_compartments(
        *shape, fibre_directions(*shape, muscles), muscles, float(source.condyles[:, 0].mean())
    )
    divided = divide_muscles(model.weights, muscles, numbers)
    return replace(
        model, weights=divided.weights, muscle_names=divided.names, wholes=divided.wholes
    )


def jaw_tracks(
    template: Template, model: SubjectModel, options: TrackOptions = TRACKS
) -> JawTracks:
    """Return the tracks of a person's jaw: those of the template's shapes, in the person's size.

    They keep their slope against the frame of the condyles, and grow with the head.
    """
    return _tracks(template, model.jaw, model.skin.vertices, options)


def _with_tracks(frame: JawFrame, template: Template, neutral: Floats) -> JawFrame:
    found = _tracks(template, frame, neutral, TRACKS)
    sizes = CondyleTracks(found.slope, found.apart, found.length, found.opening)
    return replace(frame, tracks=sizes)


def _tracks(
    template: Template, frame: JawFrame, neutral: Floats, options: TrackOptions
) -> JawTracks:
    skin, teeth = template.skin.vertices, lower_teeth(template.regions, template.attached_mandible)
    apart = float(np.linalg.norm(template.condyles[0] - template.condyles[1]))
    shapes = [] if template.shapes is None else list(template.shapes.expressions[:, teeth])
    found = tracks_of_shapes(jaw_frame(template.condyles), apart, skin[teeth], shapes, options)
    size = fit_similarity(skin, neutral).scale
    return replace(
        found, frame=frame, apart=size * apart, length=size * found.length, bend=found.bend / size
    )


def _check(template: Template, neutral: Floats) -> None:
    expected = template.skin.vertices.shape
    if neutral.shape != expected:
        found, wanted = len(neutral), expected[0]
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
