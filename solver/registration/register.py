"""Registration of a raw scan to a template: pose, shape, free form, hidden parts, confidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.normals import vertex_normals
from solver.progress import Progress, Step, silent
from solver.registration.confidence import Trust, trust
from solver.registration.correspondence import Pins
from solver.registration.folds import folded_triangles, unfolded
from solver.registration.hidden import carry_hidden
from solver.registration.initial import Start, not_a_face, start_by_landmarks, start_by_shape
from solver.registration.nonrigid import FROM_AFAR, REFINE, free_form
from solver.registration.pose import FacePatch
from solver.registration.rigid import align
from solver.registration.scan_surface import ScanSurface
from solver.registration.shape_fit import expressions, fit_shapes, persons
from solver.registration.stabilise import head_motion
from solver.registration.topology import Topology
from solver.scans.found_landmarks import find_landmarks
from solver.scans.landmarks import landmark_vertices
from solver.scans.raw import RawScan
from solver.scans.units import FRAME
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Ints, Surface

LEAST_COVER, FARTHEST_MM = 0.15, 1.0
STILL = 0.1
"""Least weight of the vertices on which an expression's head is aligned."""


@dataclass(frozen=True)
class Registration:
    """A scan in the template's topology.

    start
        The scan in mm, its unit and its first place.
    skin
        The registered surface in mm: of a neutral in the template's frame, of an expression in its
        neutral's, without head motion.
    trust
        Confidence, cover and distance per vertex.
    motion
        Takes the scan in mm onto ``skin``.
    shape_weights
        (k,) weights of the template's identities or expressions; empty where it has none.
    folded
        Triangles of the flesh that are turned over.
    """

    start: Start
    skin: Surface
    trust: Trust
    motion: Similarity
    shape_weights: Floats
    folded: Ints


def register(
    raw: RawScan,
    topology: Topology,
    neutral: Floats | None = None,
    *,
    frame: Mapping[str, Any] = FRAME,
    landmarks: tuple[Floats, Ints] | None = None,
    landmarker: Path | None = None,
    progress: Progress = silent,
) -> Registration:
    """Register a mended scan: a neutral, or an expression if ``neutral`` (n, 3) is given.

    Parameters
    ----------
    neutral
        Vertices of the person's registered neutral.
    frame
        The options ``unit``, ``up`` and ``forward`` of the scan.
    landmarks
        Points (k, 3) in the scan's own unit and axes, and the vertices (k,) they mark.
    landmarker
        Model file with which landmarks are found if none are given.

    Raises
    ------
    InputError
        ``scan.not_a_face``, ``scan.empty``, ``options.unit``, ``options.axes``,
        ``landmarks.extra``, ``landmarks.model``.
    """
    progress(Step("pose", 0.1))
    skin = topology.template.skin
    model = skin if neutral is None else skin.moved(neutral)
    if landmarks is None:
        looked_for = topology.face if neutral is None else topology.firm
        patch = _face_patch(model, looked_for, topology.template)
        start = start_by_shape(raw, patch, frame)
        pins = None if landmarker is None else _found(start, patch, topology.template, landmarker)
    else:
        start = start_by_landmarks(raw, Pins(*landmarks), model.vertices, frame)
        pins = Pins(start.mm_per_unit * landmarks[0], landmarks[1])
    if neutral is None:
        found = _register_neutral(start, topology, pins, progress)
    else:
        found = _register_expression(start, topology, neutral, pins, progress)
    _check(raw.file, found, topology)
    return found


def _found(start: Start, patch: FacePatch, template: Template, model: Path) -> Pins | None:
    """Return the landmarks that show in pictures of the placed scan; None for a point cloud."""
    if not len(start.scan.faces):
        return None
    placed = Surface(start.motion(start.scan.vertices), start.scan.faces)
    known, found = landmark_vertices(template), find_landmarks(placed, patch.points, model)
    names = sorted(known.keys() & found.keys())
    if not names:
        return None
    points = np.array([found[name] for name in names])
    return Pins(start.motion.inverse()(points), np.array([known[name] for name in names]))


def _register_neutral(
    start: Start, topology: Topology, pins: Pins | None, progress: Progress
) -> Registration:
    scan, motion, template = start.scan, start.motion, topology.template
    rest, basis = template.skin, template.shapes
    open_size = not start.size_known
    progress(Step("shape", 0.3))
    if basis is not None and len(basis.identity):
        fit = fit_shapes(scan, motion, persons(topology, basis), topology, pins, sizes=open_size)
        shape, motion, weights, schedule = fit.vertices, fit.motion, fit.weights, REFINE
    else:
        shape, motion = _own_size(scan, motion, topology, open_size=open_size)
        weights, schedule = np.zeros(0), FROM_AFAR
    progress(Step("free form", 0.6))
    fitted = free_form(scan, motion, shape, topology, schedule, pins)
    fitted = unfolded(rest.vertices, fitted, topology.flesh)
    skin = rest.moved(carry_hidden(topology.groups, shape, shape, fitted, topology.outer))
    seen = trust(scan, motion, skin, topology.outer)
    folds = folded_triangles(rest.vertices, skin.vertices, topology.flesh)
    return Registration(start, skin, seen, motion, weights, folds)


def _register_expression(
    start: Start, topology: Topology, neutral: Floats, pins: Pins | None, progress: Progress
) -> Registration:
    scan, template = start.scan, topology.template
    rest, basis = template.skin.moved(neutral), template.shapes
    open_size = not start.size_known
    progress(Step("shape", 0.3))
    still = np.flatnonzero(topology.stable > STILL)
    normals = vertex_normals(rest)[still]
    share = topology.stable[still]
    motion = align(scan, start.motion, neutral[still], normals, share, sizes=open_size)
    shape, weights, schedule = neutral, np.zeros(0), FROM_AFAR
    if basis is not None and len(basis.expressions):
        fit = fit_shapes(scan, motion, expressions(neutral, basis), topology, pins, sizes=open_size)
        shape, motion, weights, schedule = fit.vertices, fit.motion, fit.weights, REFINE
    progress(Step("free form", 0.6))
    fitted = free_form(scan, motion, shape, topology, schedule, pins)
    fitted = unfolded(neutral, fitted, topology.flesh)
    skin = rest.moved(carry_hidden(topology.groups, neutral, shape, fitted, topology.outer))
    seen = trust(scan, motion, skin, topology.outer)
    back = head_motion(skin.vertices, shape, topology.stable * seen.confidence)
    skin = skin.moved(back(skin.vertices))
    folds = folded_triangles(neutral, skin.vertices, topology.flesh)
    return Registration(start, skin, seen, motion.then(back), weights, folds)


def _check(file: str, found: Registration, topology: Topology) -> None:
    """Raise ``scan.not_a_face`` where even free form could not come near."""
    seen = topology.face[found.trust.covered[topology.face]]
    share = len(seen) / len(topology.face)
    if share < LEAST_COVER:
        raise not_a_face(file, f"only {share:.0%} of a face could be laid on it")
    distance = float(found.trust.distance_mm[seen].mean())
    if distance > FARTHEST_MM:
        raise not_a_face(file, f"a face laid on it stays {distance:.1f} mm off on average")


def _face_patch(model: Surface, vertices: Ints, template: Template) -> FacePatch:
    """Return the face of a neutral, with the nose's tip: a landmark, or what stands out most."""
    points = model.vertices[vertices]
    tip = template.landmarks.get("nose_tip", template.landmarks.get("pronasale"))
    place = points[np.argmax(points[:, 2])] if tip is None else model.vertices[tip]
    return FacePatch(points, vertex_normals(model)[vertices], place)


def _own_size(
    scan: ScanSurface, motion: Similarity, topology: Topology, *, open_size: bool
) -> tuple[Floats, Similarity]:
    """Return the template at the scan's size, and the scan's motion onto it.

    With ``open_size`` the scan takes the template's size instead.
    """
    rest = topology.template.skin
    normals = vertex_normals(rest)[topology.face]
    before = motion.scale
    motion = align(scan, motion, rest.vertices[topology.face], normals, sizes=True)
    if open_size:
        return rest.vertices, motion
    resize = Similarity(before / motion.scale, IDENTITY.rotation, IDENTITY.shift)
    return resize(rest.vertices), motion.then(resize)
