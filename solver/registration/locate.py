"""The face in a raw scan of any pose and unit: whether there is one, where, and how large.

One search serves the check of a scan and its registration, so that they give one verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from solver.anatomy.contact_regions import eye_corners
from solver.anatomy.template import Template
from solver.errors import Finding, InputError
from solver.meshio.raw import RawScan
from solver.registration.landmarks import landmark_vertices
from solver.registration.scan_surface import Samples, orient_outward
from solver.registration.search import (
    QUICK_SEARCH,
    REFINEMENT,
    Axes,
    FacePoints,
    FacePose,
    face_points,
    find_pose,
    judge_pose,
    refine_pose,
)
from solver.registration.shape_fit import (
    LIKENESS,
    ShapeModel,
    TemplateFit,
    fit_shapes,
    full_model,
    match_samples,
)
from solver.registration.units import (
    AXES,
    FaceSize,
    ScanUnit,
    candidate_scales,
    check_frame,
    choose_unit,
    given_unit,
    unit_findings,
)
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats, Ints, Surface, vertex_areas

EXTENTS = (1e-9, 1e9)  # least and greatest extent of a scan in its own unit, whatever that is
AROUND_FACE_MM = np.full((2, 3), 25.0)  # below and above the face: what is looked at closely


def face_surface(template: Template) -> Surface:
    """Return the part of the template's skin that is fitted and nothing else, in its numbers."""
    skin = template.skin
    is_face = np.zeros(len(skin.vertices), bool)
    is_face[template.face_vertices] = True
    return Surface(skin.vertices, skin.faces[is_face[skin.faces].all(axis=1)])


@dataclass(frozen=True)
class Location:
    """The face in a scan: its pose, its size, and its place in mm."""

    pose: FacePose
    near: Samples  # of the scan, in its own frame, that the pose puts about the face
    likeness: TemplateFit | None  # of the template to the face; None where there is surely none
    is_face: bool
    size: FaceSize  # and the unit of the file
    motion: Similarity  # takes the scan in mm, without scale, to the template's face
    up: str  # axis of the file nearest to the subject's up (y)
    forward: str  # axis of the file nearest to the subject's forward (z)

    @property
    def mm_per_unit(self) -> float:
        """Return the mm of a unit of the file."""
        return self.size.unit.mm_per_unit


@dataclass(frozen=True)
class SecondLook:
    """Costs (:class:`FacePose`) of doubtful poses, which the template's shapes decide about."""

    most_cost: float = 4.0  # an open mouth between holes costs up to 3.6, as the back of a head
    likeness_cost: float = 2.6  # with shapes: faces up to 2.5, the back of a head 3.4
    shapeless_cost: float = 3.45  # without shapes; the back of a head costs 3.56 then


SECOND = SecondLook()


def locate_face(
    scan: RawScan,
    samples: Samples,
    template: Template,
    frame: Mapping[str, Any],
    marks: tuple[Floats, Floats] | None = None,
) -> Location:
    """Find the best place of the face in a scan, however bad, and with it unit and axes.

    ``scan`` is mended, in its own unit and axes, ``samples`` are of it; ``frame`` holds the options
    ``unit``, ``eye_distance_mm``, ``up`` and ``forward``, as
    :data:`~solver.registration.units.FRAME`. Landmarks (``marks``), points (k, 3) of the scan and
    of the template, replace the search: who sets them has seen a face.

    Raises what :func:`check_frame` does, and ``scan.unit_unknown`` for a scan without extent.
    """
    check_frame(frame)
    extent = _extent(samples)
    if not EXTENTS[0] < extent < EXTENTS[1]:
        message = f"No unit makes what is in {scan.file} as large as a face."
        raise InputError("scan.unit_unknown", message, file=scan.file)
    given = given_unit(frame)
    samples = orient_outward(samples)
    surface = face_surface(template)
    face = face_points(surface)
    if marks is None:
        axes = {name: np.array(axis) for name, axis in AXES.items()}
        upright = axes.get(frame["up"]), axes.get(frame["forward"])  # None for auto
        pose = _search(face, samples, given, scan.mm_per_unit, upright)
    else:
        start = fit_similarity(*marks)
        pose = refine_pose(face, samples, start, start.scale)
    motion = pose.motion
    certain = marks is not None
    about = around(motion(samples.points), surface, AROUND_FACE_MM)
    near = Samples(samples.points[about], samples.normals[about], samples.oriented)
    likeness, is_face = _judge_likeness(pose, samples, near, template, surface, certain=certain)
    unit = choose_unit(motion.scale, given, scan.mm_per_unit)
    eyes = None
    if likeness is not None:
        eyes = _measure_eyes(likeness, near, template, surface, marks)
    wanted = frame.get("eye_distance_mm")
    if wanted is not None and eyes is not None:
        unit = ScanUnit(wanted / eyes[0], "eyes")
    elif wanted is not None and is_face:
        message = f"the template {template.name} does not name the eyes' corners: give unit instead"
        raise InputError("options.unit", message)
    factor = unit.mm_per_unit
    apart = (None, None) if eyes is None else (factor * eyes[0], eyes[1])
    centre = face.points.mean(axis=0)
    there = factor * motion.inverse()(centre[None])[0]
    return Location(
        pose=pose,
        near=near,
        likeness=likeness,
        is_face=is_face,
        size=FaceSize(unit, factor / motion.scale, *apart),
        motion=Similarity(1.0, motion.rotation, centre - motion.rotation @ there),
        up=nearest_axis(motion.rotation[1]),
        forward=nearest_axis(motion.rotation[2]),
    )


def around(points: Floats, face: Surface, margins: Floats) -> NDArray[np.bool_]:
    """Return which points lie in the box about the face, larger below and above by ``margins``."""
    below, above = margins
    corners = face.vertices[np.unique(face.faces)]
    low = corners.min(axis=0) - below
    high = corners.max(axis=0) + above
    return np.asarray(((points > low) & (points < high)).all(axis=1))


def _judge_likeness(
    pose: FacePose,
    samples: Samples,
    near: Samples,
    template: Template,
    face: Surface,
    *,
    certain: bool,
) -> tuple[TemplateFit | None, bool]:
    """Return the likeness to what is ``near`` a pose, and whether it is a face; ``certain``: it is.

    A doubtful pose is a face's if it is one once the template looks like the person. A template
    without shapes stays as it is.
    """
    if not (certain or pose.is_face or pose.cost <= SECOND.most_cost):
        return None, False
    if len(near.points) < REFINEMENT.least_points:  # landmarks may lie off the scan
        return None, False
    is_face = certain or pose.is_face
    skin = template.skin.vertices
    if template.shapes is None:
        as_it_is = TemplateFit(np.zeros(0), skin, pose.motion)
        return as_it_is, is_face or pose.cost < SECOND.shapeless_cost
    shapes = full_model(skin, face, template.shapes)
    match = match_samples(near, vertex_areas(skin, face.faces)[shapes.used])
    fitted = fit_shapes(match, pose.motion, shapes, options=LIKENESS, sizes=True)
    if is_face:
        return fitted, True
    points = face_points(Surface(fitted.vertices, face.faces))
    again = judge_pose(points, samples, fitted.motion)
    return fitted, again.cost < SECOND.likeness_cost


@dataclass(frozen=True)
class EyeOptions:
    """The patch around an eye that is slid into place on the scan."""

    # distances up to which its points pair, round by round
    reaches_mm: tuple[float, ...] = (6.0,) * 6 + (4.0,) * 8 + (3.0,) * 8 + (2.0,) * 8
    radius_mm: float = 20.0
    pupils: float = 1.015  # their distance by that of the middles between the eyes' corners


EYES = EyeOptions()


def _measure_eyes(
    fitted: TemplateFit,
    samples: Samples,
    template: Template,
    face: Surface,
    marks: tuple[Floats, Floats] | None,
) -> tuple[float, float] | None:
    """Return how far the pupils lie apart in the scan's own unit, and in the template in mm.

    They lie about the middles of the eyes' corners, by landmarks where these are marked. A likeness
    has the eyes of a person like it: a patch of it around each is slid to where the scan has such
    a one. None where the template does not name the corners.
    """
    corners = np.array(list(eye_corners(landmark_vertices(template)).values()))
    if len(corners) < 2:
        return None
    rest = template.skin.vertices[corners]
    middles = [_find_eye(fitted, samples, face, pair) for pair in corners]
    if marks is not None:
        gap, near = KDTree(marks[1]).query(rest)
        middles = middles if gap.any() else [*marks[0][near].mean(axis=1)]
    in_scan, in_template = (
        EYES.pupils * float(np.linalg.norm(left - right))
        for left, right in (middles, rest.mean(axis=1))
    )
    return in_scan, in_template


def _find_eye(fitted: TemplateFit, samples: Samples, face: Surface, corners: Ints) -> Floats:
    """Return the middle (3,) between the corners of an eye in a scan, in its own frame."""
    middle = fitted.vertices[corners].mean(axis=0)
    used = np.unique(face.faces)
    patch = used[np.linalg.norm(fitted.vertices[used] - middle, axis=1) < EYES.radius_mm]
    none = np.zeros((0, *fitted.vertices.shape))
    still = ShapeModel(
        fitted.vertices, none, np.zeros((0, 0)), np.zeros(0, bool), face.faces, patch
    )
    match = match_samples(samples, np.ones(len(patch)))
    options = replace(LIKENESS, reaches_mm=EYES.reaches_mm)
    slid = fit_shapes(match, fitted.motion, still, options=options, sizes=False)
    return np.asarray(slid.motion.inverse()(middle[None])[0])


def likely_scales(scan: RawScan, samples: Samples, frame: Mapping[str, Any]) -> list[float]:
    """Return the mm per unit that come first for a scan."""
    return candidate_scales(_extent(samples), given_unit(frame), scan.mm_per_unit)[0]


def location_findings(scan: RawScan, location: Location, frame: Mapping[str, Any]) -> list[Finding]:
    """Return whether there is no face, or one of a size that is to be told.

    With an ``error`` among them nothing right would come of the scan.
    """
    if location.is_face:
        return unit_findings(scan.file, frame, scan.mm_per_unit, location.size)
    pose = location.pose
    message = (
        f"{scan.file} shows no face: the best fit covers {pose.coverage:.0%} of a face and is "
        f"{pose.residual_mm:.1f} mm off."
    )
    return [Finding("scan.not_a_face", "error", message)]


def _extent(samples: Samples) -> float:
    return float(np.ptp(np.quantile(samples.points, [0.005, 0.995], axis=0), axis=0).max())


def _search(
    face: FacePoints, samples: Samples, given: float | None, declared: float | None, upright: Axes
) -> FacePose:
    """Return the best pose, however bad: in known units first, in odd ones if none fits."""
    known, *others = candidate_scales(_extent(samples), given, declared)
    best = find_pose(face, samples, known, upright)
    for scales in others:
        unit = choose_unit(best.motion.scale, given, declared)
        if not best.is_face or unit.source == "template":
            found = find_pose(face, samples, scales, upright, QUICK_SEARCH)
            if found.cost < best.cost:
                best = found
                known = [found.motion.scale]
    if best.is_good:
        return best
    more = [find_pose(face, samples, known, upright, first=False)]
    if known[0] == best.motion.scale:
        more.append(find_pose(face, samples, known, upright))
    return min(best, *more, key=lambda pose: pose.cost)


def nearest_axis(direction: Floats) -> str:
    """Return the name of the axis of a file that is nearest to a direction (3,) there."""
    return max(AXES, key=lambda name: float(np.dot(AXES[name], direction)))
