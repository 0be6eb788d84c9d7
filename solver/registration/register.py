"""Registration of a raw scan to a template: pose, shape, free form, hidden parts, confidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.anatomy.warp import similarity
from solver.errors import InputError
from solver.meshio.faults import empty_error
from solver.meshio.raw import RawScan
from solver.progress import Progress, Step, silent
from solver.registration.confidence import Trust, head_motion, trust
from solver.registration.landmarks import find_landmarks, landmark_vertices
from solver.registration.nonrigid import (
    FROM_AFAR,
    REFINE,
    folded_triangles,
    free_form,
    unfolded,
)
from solver.registration.pose import (
    AXES,
    EXTENT_MM,
    FRAME,
    UNITS,
    FacePatch,
    find_face,
    unit_of,
)
from solver.registration.scan_surface import ScanSurface, scan_surface
from solver.registration.shape_fit import Pins, align, expressions, fit_shapes, persons
from solver.registration.topology import Topology, carry_hidden
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Ints, Surface, vertex_normals

# Where a raw scan's face is and in what unit it was written, from landmarks or by its shape.


CLOSE_MM, FAR_MM = 5.7, 6.5
"""A face that fits better than the first on average is found; one worse than the second is none."""
HEAD_MM = (170.0, 230.0, 310.0, 420.0, 570.0)
"""Extents to try for a scan in which no face of a person's size was found."""


@dataclass(frozen=True)
class Start:
    """A scan in mm and its motion onto the face.

    ``unit`` is None where ``mm_per_unit`` is no unit's, ``size_known`` false where the size is
    only the face's it was laid on: it fits neither a unit nor a decimal slip of one.
    """

    scan: ScanSurface
    motion: Similarity
    mm_per_unit: float
    unit: str | None
    size_known: bool


def start_by_shape(raw: RawScan, patch: FacePatch, frame: Mapping[str, Any]) -> Start:
    """Find the face of a mended scan by its shape alone.

    ``frame`` holds the options ``unit``, ``up`` and ``forward``. Raises :class:`InputError`:
    ``options.unit``, ``options.axes``, ``scan.not_a_face``, ``scan.empty``.
    """
    upright = (_axis(frame, "up"), _axis(frame, "forward"))
    if not len(raw.vertices):
        raise empty_error(raw.file)
    best: tuple[float, float, ScanSurface, Similarity] | None = None
    likely, others = _factors(raw, str(frame["unit"]))
    for factors in (likely, others):
        for factor in factors:
            scan = scan_surface(raw, factor)
            motion, misfit = find_face(patch, scan, upright)
            if best is None or misfit < best[0]:
                best = misfit, factor, scan, motion
        if best is not None and best[0] < CLOSE_MM:
            break
    assert best is not None
    misfit, factor, scan, motion = best
    if misfit > FAR_MM:
        unit = f", read in {frame['unit']}," if frame["unit"] in UNITS else ""
        raise not_a_face(raw.file, f"the best place for one{unit} is {misfit:.1f} mm off")
    motion = align(scan, motion, patch.points, patch.normals, sizes=True)
    fitted = motion.scale * factor
    total, name = _unit(raw, fitted, frame)
    scan = scan if total == factor else scan_surface(raw, total)
    resized = _resized(motion, total / factor, patch.points.mean(axis=0))
    return Start(scan, resized, total, name, size_known=total != fitted)


def start_by_landmarks(raw: RawScan, pins: Pins, model: Floats, frame: Mapping[str, Any]) -> Start:
    """Place a mended scan by landmarks on the ``model`` (n, 3); the points are as in the file."""
    motion = Similarity(*similarity(pins.points, model[pins.vertices]))
    mm_per_unit, name = _unit(raw, motion.scale, frame)
    resized = _resized(motion, mm_per_unit, model[pins.vertices].mean(axis=0))
    known = mm_per_unit != motion.scale
    return Start(scan_surface(raw, mm_per_unit), resized, mm_per_unit, name, size_known=known)


def _unit(raw: RawScan, scale: float, frame: Mapping[str, Any]) -> tuple[float, str | None]:
    return unit_of(scale, str(frame["unit"]), raw.mm_per_unit)


def _resized(motion: Similarity, factor: float, centre: Floats) -> Similarity:
    """Return the motion of a scan ``factor`` times as large, without scale, about ``centre``."""
    there = factor * motion.inverse()(centre[None])[0]
    return Similarity(1.0, motion.rotation, centre - motion.rotation @ there)


def _factors(raw: RawScan, unit: str) -> tuple[list[float], list[float]]:
    """Return the mm per unit to try first, and those to try if none fits well."""
    if unit in UNITS:
        return [UNITS[unit]], []
    if unit != "auto":
        raise InputError(
            "options.unit",
            f"unit is {unit!r}, not one of auto, {', '.join(UNITS)}",
            expected=["auto", *UNITS],
        )
    low, high = np.quantile(raw.vertices, [0.005, 0.995], axis=0)
    extent = max(float((high - low).max()), 1e-30)
    declared = [] if raw.mm_per_unit is None else [raw.mm_per_unit]
    likely = [f for f in declared or UNITS.values() if EXTENT_MM[0] <= f * extent <= EXTENT_MM[1]]
    return likely, [mm / extent for mm in HEAD_MM]


def not_a_face(file: str, reason: str) -> InputError:
    """Return the error for a scan in which no face was found."""
    return InputError("scan.not_a_face", f"{file} shows no whole face: {reason}", file=file)


def _axis(frame: Mapping[str, Any], name: str) -> Floats | None:
    given = str(frame[name])
    if given == "auto":
        return None
    if given not in AXES:
        raise InputError(
            "options.axes",
            f"{name} is {given!r}, not one of auto, {', '.join(AXES)}",
            expected=["auto", *AXES],
        )
    return np.array(AXES[given])


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
