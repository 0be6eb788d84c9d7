"""Registration of a raw scan to a template: pose, shape, free form, hidden parts, confidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.template import ShapeBasis, Template
from solver.errors import Finding, InputError
from solver.meshio.raw import RawScan
from solver.progress import ProgressCallback, Step, silent
from solver.registration.landmarks import find_landmarks, landmark_vertices
from solver.registration.locate import Location, locate_face, location_findings
from solver.registration.nonrigid import (
    FROM_AFAR,
    REFINE,
    Round,
    folded_triangles,
    free_form,
    unfold,
)
from solver.registration.scan_surface import SURFACE, ScanSurface, check_size, sample, scan_surface
from solver.registration.shape_fit import (
    Pins,
    TemplateFit,
    align,
    expression_model,
    facing_weights,
    find_correspondences,
    fit_shapes,
    lid_shapes,
    neutral_model,
)
from solver.registration.topology import Topology, carry_hidden
from solver.registration.units import FRAME
from solver.similarity import IDENTITY, Similarity, robust_motion
from solver.surface import Floats, Ints, Surface, adjacency, vertex_normals

Marks = tuple[Floats, Ints]  # points (k, 3) in the scan's own frame, vertices (k,)


def find_start(
    raw: RawScan, template: Template, frame: Mapping[str, Any], landmarks: Marks | None
) -> tuple[ScanSurface, Location, list[Finding]]:
    """Return a mended scan in mm, its face, found by its shape or by ``landmarks``, and findings.

    Raises :class:`InputError`: ``options.unit``, ``options.axes``, ``scan.empty``, and what
    :func:`~solver.registration.locate.location_findings` counts as an error.
    """
    check_size(len(raw.vertices), raw.file)
    marks = landmarks and (landmarks[0], template.skin.vertices[landmarks[1]])
    place = locate_face(raw, sample(raw.vertices, raw.faces, raw.normals), template, frame, marks)
    findings = location_findings(raw, place, frame)
    for finding in findings:
        if finding.severity == "error":
            raise InputError(finding.code, finding.message, file=raw.file, **finding.context)
    near = near_head(raw, place, template.skin.vertices)
    return scan_surface(near, place.mm_per_unit), place, findings


def near_head(
    raw: RawScan, place: Location, skin: Floats, most: int = SURFACE.max_vertices
) -> RawScan:
    """Return a scan of more than ``most`` vertices without what is far from a template's ``skin``.

    It has to be thinned, and a body beside the face, or one stray point, would make the face
    itself coarse.
    """
    if len(raw.vertices) <= most:
        return raw
    points = place.motion(place.mm_per_unit * raw.vertices)
    low = skin.min(axis=0) - AROUND_HEAD_MM
    high = skin.max(axis=0) + AROUND_HEAD_MM
    is_near = ((points > low) & (points < high)).all(axis=1)
    faces = raw.faces[is_near[raw.faces].all(axis=1)]
    numbers = np.cumsum(is_near) - 1
    return raw.part(np.flatnonzero(is_near), numbers[faces])


AROUND_HEAD_MM = 40.0  # what is looked at around the template's skin
LEAST_COVER = 0.15  # of a face by free form: with less it is none
FARTHEST_MM = 1.0  # that it is off on average: farther it is none
STILL = 0.1  # least weight of the vertices on which an expression's head is aligned


@dataclass(frozen=True)
class RegisteredFace:
    """A scan in the template's topology."""

    scan: ScanSurface  # in mm
    start: Location  # of its face, before registration
    # In mm: a neutral in the template's frame, an expression in its neutral's, the head still.
    skin: Surface
    scanned: Surface  # the same with lids as the scan has them
    opened: Mapping[str, float]  # side -> weight of the template's shut lids, which were opened
    trust: Trust
    motion: Similarity  # takes the scan in mm onto ``skin``
    shape_weights: Floats  # (k,) of the template's identities or expressions; empty without any
    folded: Ints  # triangles of the flesh that are turned over
    size_findings: list[Finding]  # what the check says of the scan's size as well


def register(
    raw: RawScan,
    topology: Topology,
    neutral: Floats | None = None,
    *,
    frame: Mapping[str, Any] = FRAME,
    landmarks: Marks | None = None,
    landmarker: Path | None = None,
    progress: ProgressCallback = silent,
) -> RegisteredFace:
    """Register a mended scan: a neutral, or an expression if ``neutral`` (n, 3) is given.

    ``frame`` holds the options of unit and axes, as :data:`FRAME`; ``landmarks`` are
    points (k, 3) in its own unit and axes and the vertices (k,) they mark. If none are given, they
    are found with the model file ``landmarker``.

    Raises :class:`InputError`: ``scan.not_a_face``, ``scan.scale``, ``scan.unit_unknown``,
    ``scan.empty``, ``options.unit``, ``options.axes``, ``landmarks.extra``, ``landmarks.model``.
    """
    progress(Step("pose", 0.1))
    scan, start, told = find_start(raw, topology.template, frame, landmarks)
    pins = None
    if landmarks is not None:
        pins = Pins(start.mm_per_unit * landmarks[0], landmarks[1])
    elif landmarker is not None:
        pins = _find_pins(scan, start.motion, topology, landmarker)
    if neutral is not None and start.size.is_measured:
        message = f"{raw.file} gets the neutral's size."
        code = "scan.size" if start.size.is_known else "scan.unit_unknown"
        told = [Finding(code, "info", message)]
    progress(Step("shape", 0.3))
    lids = _Lids.none(topology.template.skin)
    if neutral is None:
        fit, schedule, lids = _fit_person(scan, start, topology, pins)
        rest = topology.template.skin.vertices + lids.motion
        placed = fit.vertices - lids.motion
    else:
        fit, schedule = _fit_expression(scan, start, topology, neutral, pins)
        rest = placed = neutral
    progress(Step("free form", 0.6))
    vertices = free_form(scan, fit.motion, fit.vertices, topology, schedule, pins)
    vertices = unfold(rest, vertices, topology.flesh)
    vertices = carry_hidden(topology.groups, placed, fit.vertices, vertices, topology.outer)
    skin = topology.template.skin.with_vertices(vertices)
    motion = fit.motion
    seen = trust(scan, motion, skin, topology.outer)
    if neutral is not None:
        back = head_motion(vertices, fit.vertices, topology.stable * seen.confidence)
        skin = skin.with_vertices(back(vertices))
        motion = motion.then(back)
    _check(raw.file, seen, topology)
    folded = folded_triangles(rest, skin.vertices, topology.flesh)
    opened = skin.with_vertices(skin.vertices - lids.motion)
    is_still = np.linalg.norm(lids.motion, axis=1) < LIDS_STILL_MM
    seen = replace(seen, confidence=seen.confidence * is_still)
    parts = scan, start, opened, skin, lids.weights, seen, motion, fit.weights, folded, told
    return RegisteredFace(*parts)


def _find_pins(
    scan: ScanSurface, motion: Similarity, topology: Topology, model: Path
) -> Pins | None:
    """Return the landmarks that show in pictures of the placed scan; None for a point cloud."""
    if not len(scan.faces):
        return None
    placed = Surface(motion(scan.vertices), scan.faces)
    face = topology.template.skin.vertices[topology.face]
    known = landmark_vertices(topology.template)
    found = find_landmarks(placed, face, model)
    names = sorted(known.keys() & found.keys())
    if not names:
        return None
    points = np.array([found[name] for name in names])
    return Pins(motion.inverse()(points), np.array([known[name] for name in names]))


SHUT = 0.7  # weight from which on lids are shut, and not those of narrow eyes
LIDS_STILL_MM = 0.5  # what moves further as lids are opened was not seen where it is then


@dataclass(frozen=True)
class _Lids:
    """Lids that a scan has shut, side -> weight, and the ``motion`` (n, 3) that shuts them."""

    weights: Mapping[str, float]
    motion: Floats

    @classmethod
    def none(cls, skin: Surface) -> _Lids:
        """Return those of a scan with open eyes."""
        return cls({}, np.zeros_like(skin.vertices))

    @classmethod
    def of(cls, basis: ShapeBasis, weights: Floats) -> _Lids:
        """Return those that are shut of the last ``weights``, which are those of all lids."""
        shapes = lid_shapes(basis)
        every = zip(shapes, weights[len(basis.identity) :].tolist(), strict=True)
        shut = {side: weight for side, weight in every if weight >= SHUT}
        motion = np.zeros(basis.identity.shape[1:])
        for side, weight in shut.items():
            motion += weight * shapes[side]
        return cls(shut, motion)


def _fit_person(
    scan: ScanSurface, start: Location, topology: Topology, pins: Pins | None
) -> tuple[TemplateFit, tuple[Round, ...], _Lids]:
    """Return a neutral's shape, the rounds that follow, and the lids that it has shut.

    Without shapes it is the template's, sized.
    """
    basis = topology.template.shapes
    rest = topology.template.skin
    face = topology.face
    if basis is not None and len(basis.identity):
        match = partial(find_correspondences, scan)
        shapes = neutral_model(topology, basis)
        fit = fit_shapes(match, start.motion, shapes, pins, sizes=not start.size.is_known)
        lids = _Lids.of(basis, fit.weights)
        return replace(fit, weights=fit.weights[: len(basis.identity)]), REFINE, lids
    normals = vertex_normals(rest)[face]
    motion = align(scan, start.motion, rest.vertices[face], normals, sizes=True)
    if not start.size.is_known:  # the scan takes the template's size
        return TemplateFit(np.zeros(0), rest.vertices, motion), FROM_AFAR, _Lids.none(rest)
    resize = replace(IDENTITY, scale=start.motion.scale / motion.scale)
    sized = TemplateFit(np.zeros(0), resize(rest.vertices), motion.then(resize))
    return sized, FROM_AFAR, _Lids.none(rest)


def _fit_expression(
    scan: ScanSurface, start: Location, topology: Topology, neutral: Floats, pins: Pins | None
) -> tuple[TemplateFit, tuple[Round, ...]]:
    """Return an expression's shape and the rounds that follow; without shapes the neutral's."""
    # the neutral's size is surer than one that was measured on this scan's own face
    basis = topology.template.shapes
    sizes = start.size.is_measured
    still = np.flatnonzero(topology.stable > STILL)
    normals = vertex_normals(topology.template.skin.with_vertices(neutral))[still]
    share = topology.stable[still]
    motion = align(scan, start.motion, neutral[still], normals, share, sizes=sizes)
    if basis is None or not len(basis.expressions):
        return TemplateFit(np.zeros(0), neutral, motion), FROM_AFAR
    shapes = expression_model(neutral, topology, basis)
    match = partial(find_correspondences, scan)
    return fit_shapes(match, motion, shapes, pins, sizes=sizes), REFINE


def _check(file: str, found: Trust, topology: Topology) -> None:
    """Raise ``scan.not_a_face`` where even free form could not come near."""
    seen = topology.face[found.covered[topology.face]]
    share = len(seen) / len(topology.face)
    reason = f"only {share:.0%} of a face could be laid on it"
    if share >= LEAST_COVER:
        distance = float(found.distance_mm[seen].mean())
        if distance <= FARTHEST_MM:
            return
        reason = f"a face laid on it stays {distance:.1f} mm off on average"
    raise InputError("scan.not_a_face", f"{file} shows no whole face: {reason}", file=file)


@dataclass(frozen=True)
class ConfidenceOptions:
    """Limits of what a scan says of a registered vertex."""

    covered_mm: float = 10.0  # farther there is no data
    covered_cosine: float = 0.5  # of the normals, at least
    trusted_mm: float = 2.0  # distance at which confidence has fallen to 1/e


CONFIDENCE = ConfidenceOptions()


@dataclass(frozen=True)
class Trust:
    """Per skin vertex: ``confidence`` (n,) in [0, 1], ``covered`` (n,), ``distance_mm`` (n,).

    A vertex is covered where the scan has data: outer skin whose closest scan point is not on an
    edge of the scan, within 10 mm, and faces the same way. Elsewhere the confidence is 0 and the
    distance NaN.
    """

    confidence: Floats
    covered: NDArray[np.bool_]
    distance_mm: Floats


def trust(scan: ScanSurface, motion: Similarity, skin: Surface, outer: Ints) -> Trust:
    """Compare a registered ``skin`` with the scan that ``motion`` takes to it.

    Confidence is the product of a term of distance, one of the angle between the normals, and the
    share of neighbours that are covered, so that it fades towards holes.
    """
    count = len(skin.vertices)
    normals = vertex_normals(skin)[outer]
    found = scan.closest(motion.inverse()(skin.vertices[outer]))
    distance = found.distance * motion.scale
    cosine = np.einsum("nd,nd->n", normals, motion.turn(found.normals))
    seen = (
        ~found.at_edge & (distance < CONFIDENCE.covered_mm) & (cosine > CONFIDENCE.covered_cosine)
    )
    covered = np.zeros(count, dtype=bool)
    covered[outer] = seen
    near = np.zeros(count)
    near[outer] = np.exp(-((distance / CONFIDENCE.trusted_mm) ** 2))
    near[outer] *= facing_weights(cosine, CONFIDENCE.covered_cosine)
    apart = np.full(count, np.nan)
    apart[outer[seen]] = distance[seen]
    graph = adjacency(skin.faces, count)
    have = covered.astype(float)
    every = np.zeros(count)
    every[outer] = 1.0
    for _ in range(2):  # neighbours within two edges
        have = graph @ have + have
        every = graph @ every + every
    return Trust(np.where(covered, near * have / np.maximum(every, 1e-12), 0.0), covered, apart)


STEPS = 6  # of reweighting
SLACK_MM = 0.5  # a vertex that moves by more on its own loses its say


def head_motion(registered: Floats, expected: Floats, weights: Floats) -> Similarity:
    """Return the rigid motion that takes ``registered`` (n, 3) back onto ``expected`` (n, 3).

    ``weights`` (n,) say how still and how well seen each vertex is; vertices that move on their
    own by more than about :data:`SLACK_MM` lose their say. This is rigid stabilisation after Beeler
    & Bradley, "Rigid stabilization of facial expressions" (SIGGRAPH 2014), with the expression's
    fitted shapes, instead of a skull, telling skin motion from head motion.
    """
    used = np.flatnonzero(weights > 1e-3)
    if len(used) < 10:
        return IDENTITY
    return robust_motion(registered[used], expected[used], weights[used], SLACK_MM, STEPS)
