"""The unit and the axes of a raw scan, found by its face or given; its place in mm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.errors import InputError
from solver.scans.pose import (
    FacePoints,
    Pose,
    all_directions,
    axis_directions,
    directions_around,
    find_pose,
    is_face,
    is_good,
)
from solver.scans.raw import RawScan
from solver.scans.sample import Samples, sample
from solver.surface import Floats, Surface

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
AXES = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
FRAME = {"unit": "auto", "up": "auto", "forward": "auto"}
"""The options of every job that reads a raw scan, with their defaults."""
EXTENT_MM = (90.0, 1100.0)  # a bare face to two people's shoulders
ODD_FACTORS = (0.001, 0.1, 10.0, 1000.0)
LADDER = 1.35
SAMPLES = 20000


@dataclass(frozen=True)
class Placement:
    """A raw scan's place: mm in the subject's axes, its face over the template's.

    x_mm = rotation (mm_per_unit x) + translation. ``unit`` is None if the scan's size fits no
    unit; ``size`` is the face's size by the template's. ``up`` and ``forward`` are the axes of the
    file that come nearest to the subject's. ``pose`` is the similarity onto the template's face.
    """

    unit: str | None
    mm_per_unit: float
    up: str
    forward: str
    rotation: Floats
    translation: Floats
    size: float
    pose: Pose

    def apply(self, points: Floats) -> Floats:
        """Return points (n, 3) of the file in mm in the subject's frame."""
        return self.mm_per_unit * points @ self.rotation.T + self.translation


def face_of(template: Template) -> Surface:
    """Return the part of the template's skin that is fitted and nothing else, in its numbers."""
    skin = template.skin
    is_face = np.zeros(len(skin.vertices), bool)
    is_face[template.face_vertices] = True
    return Surface(skin.vertices, skin.faces[is_face[skin.faces].all(axis=1)])


def samples_of(scan: RawScan, count: int = SAMPLES) -> Samples:
    """Return points spread over the scan, in its own frame; what is not a number is left out."""
    finite = np.asarray(np.isfinite(scan.vertices).all(axis=1))
    vertices = np.where(finite[:, None], scan.vertices, 0.0)
    if len(scan.faces):
        return sample(vertices, scan.faces[finite[scan.faces].all(axis=1)], None, count)
    normals = None if scan.normals is None else np.nan_to_num(scan.normals[finite])
    return sample(vertices[finite], scan.faces, normals, count)


def place_samples(
    samples: Samples, face: FacePoints, frame: Mapping[str, Any], declared: float | None
) -> Placement:
    """Find the best place of the face in ``samples``, however bad, and with it unit and axes.

    ``frame`` gives ``unit``, ``up`` and ``forward`` (as :data:`FRAME`), ``declared`` the mm per
    unit that the format declares. Raises :class:`InputError`: ``options.unit``, ``options.axes``.
    """
    directions = [_within(start, frame) for start in (axis_directions(), all_directions())]
    low, high = np.quantile(samples.points, [0.005, 0.995], axis=0)
    extent = float((high - low).max())
    poses: list[Pose] = []

    def is_found(scales: list[float], starts: Floats) -> bool:
        poses.append(find_pose(face, samples, scales, starts))
        poses.sort(key=lambda pose: pose.cost)
        return is_good(poses[0])

    rounds = _scale_rounds(extent, str(frame["unit"]), declared)
    for number, scales in enumerate(rounds):
        likely = directions if number + 1 < len(rounds) else directions[:1]
        if any(is_found(scales, starts) for starts in likely):
            break
        if is_found([poses[0].scale], directions_around(poses[0].rotation)) or is_face(poses[0]):
            break
    return _placement(poses[0], face, str(frame["unit"]), declared)


def _within(directions: Floats, frame: Mapping[str, Any]) -> Floats:
    """Return those start directions (n, 3, 3) that turn the given axes about right."""
    kept = np.ones(len(directions), bool)
    for row, name in ((1, "up"), (2, "forward")):
        given = str(frame[name])
        if given == "auto":
            continue
        if given not in AXES:
            raise InputError(
                "options.axes",
                f"{name} is {given!r}, not one of auto, {', '.join(AXES)}",
                expected=["auto", *AXES],
            )
        kept &= np.asarray(directions[:, row] @ np.array(AXES[given]) > 0.8)
    if not kept.any():
        raise InputError("options.axes", "up and forward must be two different axes")
    return directions[kept]


def known_scales(extent: float, unit: str, declared: float | None) -> list[float]:
    """Return the likely mm per unit for a scan of this ``extent`` in its own unit."""
    rounds = _scale_rounds(extent, unit, declared)
    return rounds[0] if rounds else [1.0]


def _scale_rounds(extent: float, unit: str, declared: float | None) -> list[list[float]]:
    """Return lists of mm per unit to try, likelier ones first."""
    if unit != "auto" and unit not in UNITS:
        raise InputError(
            "options.unit",
            f"unit is {unit!r}, not one of auto, {', '.join(UNITS)}",
            expected=["auto", *UNITS],
        )
    first = UNITS.get(unit, declared)
    low, high = EXTENT_MM
    known = [first] if first is not None else list(UNITS.values())
    slips = {(first or 1.0) * factor for factor in ODD_FACTORS}
    odd = sorted((slips | set(UNITS.values())) - set(known))
    ladder = low / max(extent, 1e-30) * LADDER ** np.arange(np.log(high / low) / np.log(LADDER))
    rounds = [
        [scale for scale in scales if low <= scale * extent <= high]
        for scales in (known, odd, ladder.tolist())
    ]
    return [scales for scales in rounds if scales]


def _placement(pose: Pose, face: FacePoints, unit: str, declared: float | None) -> Placement:
    factor, name = unit_of(pose.scale, unit, declared)
    size = factor / pose.scale
    centre = face.points.mean(axis=0)
    file_centre = (centre - pose.translation) @ pose.rotation / pose.scale
    return Placement(
        unit=name,
        mm_per_unit=factor,
        up=_nearest_axis(pose.rotation[1]),
        forward=_nearest_axis(pose.rotation[2]),
        rotation=pose.rotation,
        translation=centre - factor * pose.rotation @ file_centre,
        size=size,
        pose=pose,
    )


PLAUSIBLE_SIZES = (0.77, 1.3)


def unit_of(scale: float, unit: str, declared: float | None) -> tuple[float, str | None]:
    """Return mm per unit and the unit's name for a fitted scale to the template.

    The given unit comes first, then the declared one, then the one that makes the likeliest size,
    then any decimal slip of one (without a name), then the template's size.
    """
    names = {factor: name for name, factor in UNITS.items()}
    first = UNITS.get(unit, declared)
    known = ([first] if first is not None else []) + list(UNITS.values())
    slips = [factor * (first or 1.0) for factor in ODD_FACTORS]
    for factor in [*known, *slips]:
        if PLAUSIBLE_SIZES[0] <= factor / scale <= PLAUSIBLE_SIZES[1]:
            return factor, names.get(factor)
    return scale, None


def _nearest_axis(direction: Floats) -> str:
    return max(AXES, key=lambda name: float(np.dot(AXES[name], direction)))
