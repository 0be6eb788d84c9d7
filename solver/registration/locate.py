"""The face in a raw scan of any pose and unit: whether there is one, where, and in what unit.

One search serves the check of a scan and its registration, so that they give one verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.errors import Finding, InputError, Severity
from solver.meshio.raw import RawScan
from solver.registration.scan_surface import Samples, orient_outward, sample
from solver.registration.search import (
    QUICK_SEARCH,
    Axes,
    FacePoints,
    FacePose,
    face_points,
    find_pose,
    judge_pose,
    refine_pose,
)
from solver.registration.shape_fit import LIKENESS, ShapeFit, fit_shapes, full_model, match_samples
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats, Surface, vertex_areas

SCAN_SAMPLES = 60_000  # points that stand for a scan
EXTENTS = (1e-9, 1e9)  # least and greatest extent of a scan in its own unit, whatever that is


def face_surface(template: Template) -> Surface:
    """Return the part of the template's skin that is fitted and nothing else, in its numbers."""
    skin = template.skin
    is_face = np.zeros(len(skin.vertices), bool)
    is_face[template.face_vertices] = True
    return Surface(skin.vertices, skin.faces[is_face[skin.faces].all(axis=1)])


def scan_samples(scan: RawScan) -> Samples:
    """Return points spread over the scan, in its own frame; what is not a number is left out."""
    finite = np.asarray(np.isfinite(scan.vertices).all(axis=1))
    vertices = np.where(finite[:, None], scan.vertices, 0.0)
    if len(scan.faces):
        return sample(vertices, scan.faces[finite[scan.faces].all(axis=1)], None, SCAN_SAMPLES)
    normals = None if scan.normals is None else np.nan_to_num(scan.normals[finite])
    return sample(vertices[finite], scan.faces, normals, SCAN_SAMPLES)


@dataclass(frozen=True)
class Location:
    """The face in a scan: its pose, the unit of the file, and its place in mm."""

    pose: FacePose
    is_face: bool
    unit: str | None  # None if the scan's size fits none by name
    mm_per_unit: float
    size_known: bool  # false if it fits no decimal slip of a unit: it is then the template's
    motion: Similarity  # takes the scan in mm, without scale, to the template's face
    size: float  # of the face by the template's
    up: str  # axis of the file nearest to the subject's up (y)
    forward: str  # axis of the file nearest to the subject's forward (z)


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

    ``scan`` is mended, in its own unit and axes, ``samples`` are of it (:func:`scan_samples`);
    ``frame`` holds the options ``unit``, ``up`` and ``forward``, as :data:`FRAME`. Landmarks
    (``marks``), points (k, 3) of the scan and of the template, replace the search: who sets them
    has seen a face.

    Raises what :func:`check_frame` does, and ``scan.unit_unknown`` for a scan without extent.
    """
    check_frame(frame)
    extent = _extent(samples)
    if not EXTENTS[0] < extent < EXTENTS[1]:
        message = f"No unit makes what is in {scan.file} as large as a face."
        raise InputError("scan.unit_unknown", message, file=scan.file)
    unit, samples = str(frame["unit"]), orient_outward(samples)
    surface = face_surface(template)
    face = face_points(surface)
    if marks is None:
        pose = _search(face, samples, unit, scan.mm_per_unit, _given_axes(frame))
    else:
        start = fit_similarity(*marks)
        pose = refine_pose(face, samples, KDTree(samples.points), start, start.scale)
    motion = pose.motion
    factor, name = choose_unit(motion.scale, unit, scan.mm_per_unit)
    centre = face.points.mean(axis=0)
    there = factor * motion.inverse()(centre[None])[0]
    return Location(
        pose=pose,
        is_face=marks is not None or pose.is_face or _is_likeness(pose, samples, template, surface),
        unit=name,
        mm_per_unit=factor,
        size_known=factor != motion.scale,
        motion=Similarity(1.0, motion.rotation, centre - motion.rotation @ there),
        size=factor / motion.scale,
        up=_nearest_axis(motion.rotation[1]),
        forward=_nearest_axis(motion.rotation[2]),
    )


def fit_likeness(
    samples: Samples, motion: Similarity, template: Template, face: Surface
) -> ShapeFit:
    """Return the template's likeness to the person; a template without shapes as it is."""
    skin = template.skin.vertices
    if template.shapes is None:
        return ShapeFit(np.zeros(0), skin, motion)
    shapes = full_model(skin, face, template.shapes)
    match = match_samples(samples, vertex_areas(skin, face.faces)[shapes.used])
    return fit_shapes(match, motion, shapes, options=LIKENESS, sizes=True)


def _is_likeness(
    pose: FacePose, samples: Samples, template: Template, face: Surface, look: SecondLook = SECOND
) -> bool:
    """Tell whether a doubtful pose is a face's once the template looks like the person."""
    if template.shapes is None:
        return pose.cost < look.shapeless_cost
    if pose.cost > look.most_cost:
        return False
    fitted = fit_likeness(samples, pose.motion, template, face)
    points = face_points(Surface(fitted.vertices, face.faces))
    again = judge_pose(points, samples, KDTree(samples.points), fitted.motion)
    return again.cost < look.likeness_cost


def likely_scales(scan: RawScan, samples: Samples, frame: Mapping[str, Any]) -> list[float]:
    """Return the mm per unit that come first for a scan."""
    return candidate_scales(_extent(samples), str(frame["unit"]), scan.mm_per_unit)[0]


def location_findings(scan: RawScan, location: Location, frame: Mapping[str, Any]) -> list[Finding]:
    """Return whether there is no face, or one of a size that speaks against the unit.

    The unit is the one that was given, declared or assumed. With an ``error`` among them nothing
    right would come of the scan.
    """
    if not location.is_face:
        pose = location.pose
        message = (
            f"{scan.file} shows no face: the best fit covers {pose.coverage:.0%} of a face and is "
            f"{pose.residual_mm:.1f} mm off."
        )
        return [Finding("scan.not_a_face", "error", message)]
    given, found = str(frame["unit"]), location.mm_per_unit
    expected = UNITS.get(given, scan.mm_per_unit or 1.0)
    if found == expected:
        return []
    figures = {"expected": expected, "found": found, "unit": location.unit}
    ratio = expected / found
    size = f"{ratio:.3g} times too large" if ratio > 1 else f"{1 / ratio:.3g} times too small"
    if location.unit is None and not np.isclose(found / expected, UNIT_OPTIONS.slips).any():
        no_unit = f"No unit makes the face in {scan.file} as large as a face"
        if given != "auto":
            no_unit = f"Read as given, the face in {scan.file} would be {size}, in no unit right"
        message = f"{no_unit}; it gets the template's size."
        return [Finding("scan.unit_unknown", "warning", message, context=figures)]
    severity: Severity = "error" if given != "auto" else "warning"
    declared = "as the format says" if scan.mm_per_unit else "in mm"
    source = "as given" if given != "auto" else declared
    as_what = f"in {location.unit}" if location.unit else f"at {found:g} mm a unit"
    message = f"Read {source}, the face would be {size}; it fits {as_what}."
    return [Finding("scan.scale", severity, message, context=figures)]


def _extent(samples: Samples) -> float:
    return float(np.ptp(np.quantile(samples.points, [0.005, 0.995], axis=0), axis=0).max())


def _search(
    face: FacePoints, samples: Samples, unit: str, declared: float | None, upright: Axes
) -> FacePose:
    """Return the best pose, however bad: in known units first, in odd ones if none fits."""
    known, *others = candidate_scales(_extent(samples), unit, declared)
    best = find_pose(face, samples, known, upright)
    for scales in others:
        if not best.is_face or choose_unit(best.motion.scale, unit, declared)[1] is None:
            found = find_pose(face, samples, scales, upright, QUICK_SEARCH)
            if found.cost < best.cost:
                best, known = found, [found.motion.scale]
    if best.is_good:
        return best
    more = [find_pose(face, samples, known, upright, first=False)]
    if known[0] == best.motion.scale:
        more.append(find_pose(face, samples, known, upright))
    return min(best, *more, key=lambda pose: pose.cost)


# Units and axes of a raw scan: those a file may have, and those that a face's size speaks for.

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # name -> mm
AXES = {  # name -> direction in the file's frame
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
# The options of every job that reads a raw scan, with their defaults.
FRAME = {"unit": "auto", "up": "auto", "forward": "auto"}


@dataclass(frozen=True)
class UnitOptions:
    """Sizes of scans and faces that are likely, for finding a scan's unit."""

    extent_mm: tuple[float, float] = (90.0, 1100.0)  # a bare face to two people's shoulders
    slips: tuple[float, ...] = (0.001, 0.1, 10.0, 1000.0)  # factors of a unit that is mixed up
    ladder_mm: tuple[float, ...] = (310.0, 230.0, 420.0, 170.0, 570.0)  # scans, likely ones first
    face_sizes: tuple[float, float] = (0.77, 1.3)  # of persons, by the template's face


UNIT_OPTIONS = UnitOptions()


def check_frame(frame: Mapping[str, Any]) -> None:
    """Raise :class:`InputError` (``options.unit``, ``options.axes``) for what does not exist."""
    for name, known in {"unit": [*UNITS], "up": [*AXES], "forward": [*AXES]}.items():
        given = str(frame[name])
        if given not in ("auto", *known):
            message = f"{name} is {given!r}, not one of auto, {', '.join(known)}"
            code = "options.unit" if name == "unit" else "options.axes"
            raise InputError(code, message, expected=["auto", *known])
    up, forward = str(frame["up"]), str(frame["forward"])
    if "auto" not in (up, forward) and up.lstrip("-") == forward.lstrip("-"):
        raise InputError("options.axes", "up and forward must be two different axes")


def _given_axes(frame: Mapping[str, Any]) -> Axes:
    """Return the directions (3,) that ``frame`` gives for ``up`` and ``forward``; None for auto."""
    known = {name: np.array(axis) for name, axis in AXES.items()}
    return known.get(frame["up"]), known.get(frame["forward"])


def _nearest_axis(direction: Floats) -> str:
    return max(AXES, key=lambda name: float(np.dot(AXES[name], direction)))


def candidate_scales(
    extent: float, unit: str, declared: float | None, options: UnitOptions = UNIT_OPTIONS
) -> list[list[float]]:
    """Return lists of mm per unit to try for a scan of this ``extent``, the likelier ones first.

    ``declared`` is the mm per unit of the file's format. Known units come first, then those that
    are wrong by a decimal slip, then sizes of heads whatever the unit.
    """
    low, high = options.extent_mm
    first = UNITS.get(unit, declared)
    known = [first] if first is not None else list(UNITS.values())
    slips = {(first or 1.0) * factor for factor in options.slips}
    odd = sorted((slips | set(UNITS.values())) - set(known))
    ladder = [size / extent for size in options.ladder_mm]
    rounds = [
        [scale for scale in scales if low <= scale * extent <= high]
        for scales in (known, odd, ladder)
    ]
    return [scales for scales in rounds if scales]


def choose_unit(
    scale: float, unit: str, declared: float | None, options: UnitOptions = UNIT_OPTIONS
) -> tuple[float, str | None]:
    """Return mm per unit and the unit's name for a ``scale`` that takes a face to the template's.

    The given unit comes first, then the declared one, then the one that makes the likeliest size,
    then any decimal slip of one (without a name), then the template's size.
    """
    names = {factor: name for name, factor in UNITS.items()}
    first = UNITS.get(unit, declared)
    known = ([first] if first is not None else []) + list(UNITS.values())
    slips = [factor * (first or 1.0) for factor in options.slips]
    for factor in [*known, *slips]:
        if options.face_sizes[0] <= factor / scale <= options.face_sizes[1]:
            return factor, names.get(factor)
    return scale, None
