"""From a template and a neutral scan to a subject model."""

from __future__ import annotations

from typing import Any

import igl
import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from solver.anatomy.closing import harmonic_displacement, untangled
from solver.anatomy.domain import (
    DEEP_FACTOR,
    Flesh,
    Label,
    Planes,
    choose_flesh,
    domain_soup,
    edge_lengths,
    joined,
    label_tets,
)
from solver.anatomy.embedding import embed
from solver.anatomy.jaw_frame import jaw_frame
from solver.anatomy.muscle_weights import enclosed_volume, initial_weights, muscle_volumes
from solver.anatomy.template import Template
from solver.anatomy.tetrahedra import smallest_dihedral_angle, tetrahedralize, volumes
from solver.anatomy.transfer import Carried, carry
from solver.errors import InputError, SolveError
from solver.model import SubjectModel
from solver.progress import Progress, Step, silent
from solver.surface import Floats, Ints

EDGE_MM = 9.0
ENVELOPE = 0.08
"""Distance between flesh surface and skin as a part of the edge length."""
GREATEST_ENVELOPE_MM = 1.6
MESHER_SECONDS = 900.0
JAW_FREE_MM = 15.0
"""Within this distance of the mandible a cut plane is free: the jaw's angle moves with the jaw."""
FRONTALIS_MM = 6.0
"""Forehead: the skull's vertices this near to the frontalis slide instead of being fixed."""
EMBED_MM = 0.25
"""Skin further from the flesh than this part of the edge length does not follow it."""


def build_subject_model(
    template: Template, neutral: Floats, *, edge_mm: float = EDGE_MM, progress: Progress = silent
) -> SubjectModel:
    """Return the tetrahedral face of the person with the neutral scan ``neutral`` (n, 3) in mm.

    Parameters
    ----------
    template
        Anatomy in the topology of the scan.
    neutral
        The registered neutral scan: the template's skin vertices in the person.
    edge_mm
        Edge length of tetrahedra on the face; lips, eyes and nose are finer, neck and scalp
        coarser. 9 mm gives about 7k vertices and 25k tetrahedra.
    progress
        Told about the phases ``transfer``, ``mesh``, ``muscles`` and ``embedding``.

    Raises
    ------
    InputError
        ``scan.vertex_count`` or ``scan.nan``.
    SolveError
        ``mesher.timeout``, ``mesher.crashed``, ``mesh.inverted`` or ``mesh.uncovered``.
    """
    _check(template, neutral)
    planes = _planes(template, neutral)
    progress(Step("transfer", 0.0))
    carried = carry(template, neutral)
    progress(Step("mesh", 0.05, message="tetrahedra by fTetWild"))
    flesh = _mesh(template, carried, planes, edge_mm)
    progress(Step("mesh", 0.85, message="closing the lips"))
    rest = _closed(carried, template.flesh_faces, flesh)
    progress(Step("muscles", 0.9))
    surfaces = [muscle.surface for muscle in carried.muscles]
    weights = initial_weights(rest, flesh.tets, surfaces)
    progress(Step("embedding", 0.97))
    embedded, rows, jaw_skin = _embedding(template, carried, flesh, planes, edge_mm)
    held = _held(carried, flesh)
    model = SubjectModel(
        rest=rest,
        tets=flesh.tets,
        cranium=held["cranium"],
        mandible=held["mandible"],
        cut=held["cut"],
        sliding=held["sliding"],
        muscle_names=tuple(muscle.name for muscle in carried.muscles),
        weights=weights,
        skin=carried.skin,
        embedded=embedded,
        embedding=rows,
        offset=neutral[embedded] - rows @ rest,
        attached_mandible=jaw_skin,
        face=template.face_vertices,
        jaw=jaw_frame(carried.condyles),
        muscles={muscle.name: muscle.surface for muscle in carried.muscles},
        bones={"cranium": carried.cranium, "mandible": carried.mandible},
        regions=template.regions,
        template={"name": template.name, "version": template.version},
    )
    progress(Step("embedding", 1.0))
    return model


def _check(template: Template, neutral: Floats) -> None:
    expected = template.skin.vertices.shape
    if neutral.shape != expected:
        raise InputError(
            "scan.vertex_count",
            f"the neutral has {len(neutral)} vertices, the template '{template.name}' has "
            f"{expected[0]}",
            expected=expected[0],
            found=len(neutral),
        )
    wrong = np.flatnonzero(~np.isfinite(neutral).all(axis=1))
    if len(wrong):
        raise InputError(
            "scan.nan",
            f"vertex {wrong[0]} of the neutral is not finite",
            vertex=int(wrong[0]),
        )


def _planes(template: Template, neutral: Floats) -> Planes:
    """Return the template's planes, moved outwards where this face reaches further."""
    reach = neutral[template.face_vertices].min(axis=0) - template.skin.vertices[
        template.face_vertices
    ].min(axis=0)
    return Planes(
        back_z=template.back_z + min(0.0, float(reach[2])),
        bottom_y=template.bottom_y + min(0.0, float(reach[1])),
    )


def _mesh(template: Template, carried: Carried, planes: Planes, edge_mm: float) -> Flesh:
    soup = domain_soup(carried, template.flesh_faces, planes)
    lengths = edge_lengths(
        soup, carried.parted.vertices, template.face_vertices, template.regions, edge_mm
    )
    vertices, tets = tetrahedralize(
        soup,
        DEEP_FACTOR * edge_mm,
        envelope_mm=min(ENVELOPE * edge_mm, GREATEST_ENVELOPE_MM),
        lengths=lengths,
        timeout_s=MESHER_SECONDS,
    )
    labels = label_tets(vertices, tets, carried, template.flesh_faces, planes)
    return choose_flesh(vertices, tets, labels)


def _closed(carried: Carried, flesh_faces: Ints, flesh: Flesh) -> Floats:
    """Return the flesh's vertices (p, 3) in the neutral pose."""
    skin_side = np.unique(flesh.outside)
    held = np.unique(np.concatenate(list(flesh.held.values())))
    faces = carried.parted.faces[flesh_faces]
    parted = carried.parted.vertices
    points = np.ascontiguousarray(flesh.vertices[skin_side])
    _, face, closest = igl.point_mesh_squared_distance(points, parted, faces)
    corners = [np.ascontiguousarray(parted[faces[face][:, k]]) for k in range(3)]
    shares = igl.barycentric_coordinates(np.ascontiguousarray(closest), *corners)
    closing = (carried.skin.vertices - parted)[faces[face]]
    values = np.zeros_like(flesh.vertices)
    values[skin_side] = np.einsum("nk,nkd->nd", shares, closing)
    values[held] = 0.0
    known = np.union1d(skin_side, held)
    moved = flesh.vertices + harmonic_displacement(flesh.vertices, flesh.tets, known, values[known])
    return untangled(flesh.vertices, moved, flesh.tets, held)


def _held(carried: Carried, flesh: Flesh) -> dict[str, Ints]:
    """Return vertex numbers by what holds them; a vertex of the mandible is held by it only."""
    mandible = flesh.held[Label.MANDIBLE]
    cranium = np.setdiff1d(flesh.held[Label.CRANIUM], mandible)
    cut = np.setdiff1d(flesh.held[Label.CUT], np.union1d(mandible, cranium))
    jaw = cKDTree(carried.mandible.vertices)
    cut = cut[jaw.query(flesh.vertices[cut])[0] > JAW_FREE_MM]
    frontalis = [m.surface.vertices for m in carried.muscles if "frontalis" in m.name]
    sliding = cranium[:0]
    if frontalis:
        distance = cKDTree(np.vstack(frontalis)).query(flesh.vertices[cranium])[0]
        sliding = cranium[distance < FRONTALIS_MM]
    return {
        "cranium": np.setdiff1d(cranium, sliding),
        "mandible": mandible,
        "cut": cut,
        "sliding": sliding,
    }


def _embedding(
    template: Template, carried: Carried, flesh: Flesh, planes: Planes, edge_mm: float
) -> tuple[Ints, sp.csr_array, Ints]:
    """Return the skin vertices that follow the flesh, their rows, and those that follow the jaw.

    Vertices are bound in the parted pose: there the upper lip is far from the lower.
    """
    parted = carried.parted.vertices
    candidates = np.unique(template.skin.faces[template.flesh_faces])
    in_front = planes.in_front(parted[candidates])
    face = np.isin(candidates, template.face_vertices)
    bound = embed(parted[candidates], flesh.vertices, flesh.outside)
    near = (bound.distance < EMBED_MM * edge_mm) & in_front
    lost = candidates[face & ~near]
    if len(lost):
        raise SolveError(
            "mesh.uncovered",
            f"{len(lost)} face vertices, the first is {lost[0]}, are too far from the flesh",
            vertex=int(lost[0]),
            count=len(lost),
        )
    rest_of_skin = candidates[~near & in_front]
    to_jaw = cKDTree(carried.mandible.vertices).query(parted[rest_of_skin])[0]
    to_skull = cKDTree(carried.cranium.vertices).query(parted[rest_of_skin])[0]
    jaw_skin = np.union1d(template.attached_mandible, rest_of_skin[to_jaw < to_skull])
    return candidates[near], bound.rows[near], jaw_skin


def model_summary(model: SubjectModel) -> dict[str, Any]:
    """Return figures to judge a model by: counts, angles, embedding error, volumes, clearance."""
    misses = np.linalg.norm(model.offset, axis=1)
    on_face = np.isin(model.embedded, model.face)
    skin = model.skin.vertices
    face = np.ascontiguousarray(model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)])
    bones = joined(list(model.bones.values())).vertices
    clearance = np.sqrt(igl.point_mesh_squared_distance(bones, skin, face)[0].min())
    kept = muscle_volumes(model.rest, model.tets, model.weights)
    sizes = volumes(model.rest, model.tets)
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "inverted": int(np.sum(sizes <= 0)),
        "smallest_dihedral_deg": smallest_dihedral_angle(model.rest, model.tets),
        "volume_cm3": float(sizes.sum()) / 1000.0,
        "held": {
            name: len(getattr(model, name)) for name in ("cranium", "mandible", "cut", "sliding")
        },
        "muscles": model.muscle_count,
        "candidates_per_tet": (model.weights.nnz / len(model.tets)) - 1.0,
        "muscle_volume_cm3": {
            name: round(float(volume) / 1000.0, 3)
            for name, volume in zip(model.muscle_names, kept, strict=True)
        },
        "muscle_volume_kept": {
            name: round(float(volume) / enclosed_volume(model.muscles[name]), 2)
            for name, volume in zip(model.muscle_names, kept, strict=True)
        },
        "embedded": len(model.embedded),
        "face_vertices": len(model.face),
        "embedding_mean_mm": float(misses[on_face].mean()),
        "embedding_max_mm": float(misses[on_face].max()),
        "bone_clearance_mm": float(clearance),
    }
