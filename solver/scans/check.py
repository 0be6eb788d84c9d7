"""The ingest check: what is in a raw scan, and what is wrong with it.

Within seconds: the file and its mesh, the face's place, unit and axes, what is missing of it, how
noisy it is, mouth and eyes, landmarks. A bad scan is no exception but a verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.anatomy.template import Template
from solver.errors import InputError
from solver.meshio.raw import RawScan, read_raw
from solver.registration.mend import Samples, mend
from solver.registration.pose import (
    FacePoints,
    Placement,
    face_of,
    is_face,
    known_scales,
    place_samples,
    samples_of,
)
from solver.registration.shape_fit import fit_likeness
from solver.scans.cover import (
    Cover,
    cover,
    has_second_face,
    visible_part,
)
from solver.scans.findings import (
    Features,
    Finding,
    axis_findings,
    cover_findings,
    feature_findings,
    file_findings,
    landmark_findings,
    of_error,
    roughness_findings,
    unit_findings,
    winding_findings,
)
from solver.scans.mouth import (
    closed_eyes,
    lip_gap,
    roughness,
    spikes,
)
from solver.surface import Floats, Surface

AROUND_FACE_MM = 25.0
AROUND_HEAD_MM = np.array([[40.0, 10.0, 60.0], [40.0, 70.0, 40.0]])
"""Below and above the face along x, y, z: the head without neck and shoulders."""
FACE_SAMPLES = 60_000
EXTENTS = (1e-9, 1e9)
"""Least and greatest extent of a scan in its own unit, whatever that is."""


@dataclass
class Check:
    """What a check has found: findings, figures, and what the picture shows.

    ``scan`` is the mended scan and ``placement`` its place, both None if it can not be read;
    ``cover`` what is missing of its face, None if there is no face; ``marked`` (n,) the vertices of
    the scan with a fault.
    """

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    scan: RawScan | None = None
    placement: Placement | None = None
    cover: Cover | None = None
    marked: NDArray[np.bool_] | None = None


def check(
    path: Path, template: Template, frame: Mapping[str, Any], role: str, landmarks: Path | None
) -> Check:
    """Check the raw scan at ``path``; ``frame`` as :func:`place_samples` takes it.

    ``role`` is ``neutral``, ``expression`` or ``unknown``: an open mouth or closed eyes are only
    wrong in a neutral. Raises :class:`InputError` only for options that do not exist.
    """
    result = Check()
    try:
        raw = read_raw(path)
    except InputError as error:
        result.findings.append(of_error(error))
        return result
    scan, mending = mend(raw)
    result.findings += file_findings(raw, mending)
    result.figures |= {"vertices": len(raw.vertices), "triangles": len(raw.faces)}
    if len(scan.vertices) < 100 or (len(raw.faces) and not len(scan.faces)):
        empty = InputError("scan.empty", f"{raw.file} holds no surface", file=raw.file)
        result.findings.append(of_error(empty))
        return result
    low, high = np.quantile(scan.vertices, [0.005, 0.995], axis=0)
    if not EXTENTS[0] < float((high - low).max()) < EXTENTS[1]:
        message = f"No unit makes what is in {raw.file} as large as a face."
        result.findings.append(Finding("scan.unit_unknown", "error", message))
        return result
    result.scan = scan
    samples = samples_of(scan)
    surface = face_of(template)
    face = FacePoints(surface)
    place = place_samples(samples, face, frame, scan.mm_per_unit)
    result.figures |= {
        "coverage": round(place.pose.coverage, 3),
        "likeness_mm": round(place.pose.residual_mm, 2),
    }
    if not is_face(place.pose):
        result.findings.append(_no_face(scan, samples, surface, place, frame))
        return result
    result.placement = place
    result.figures |= {
        "unit": place.unit,
        "mm_per_unit": place.mm_per_unit,
        "up": place.up,
        "forward": place.forward,
        "size": round(place.size, 3),
    }
    result.findings += unit_findings(scan, place, frame)
    result.findings += axis_findings(place, frame)
    if has_second_face(samples, face, place.pose):
        message = f"{scan.file} shows two heads."
        result.findings.append(Finding("scan.two_heads", "error", message))
    winding = winding_findings(scan, samples, face, place)
    if landmarks is not None:
        winding = _with_landmarks(result, landmarks, template, samples, place, winding)
    result.findings += winding
    _look_closer(result, scan, place, template, surface, role)
    return result


def _no_face(
    scan: RawScan, samples: Samples, face: Surface, place: Placement, frame: Mapping[str, Any]
) -> Finding:
    """Return whether a scan without a whole face shows half a face or none."""
    extent = float(np.ptp(np.quantile(samples.points, [0.005, 0.995], axis=0), axis=0).max())
    scales = known_scales(extent, str(frame["unit"]), scan.mm_per_unit)
    part = visible_part(samples, face, scales)
    if part is not None:
        message = f"{scan.file} shows only the {part} half of a face."
        return Finding("scan.half_face", "error", message, {"part": part})
    return Finding(
        "scan.not_a_face",
        "error",
        f"{scan.file} shows no face: the best fit covers {place.pose.coverage:.0%} of a face and "
        f"is {place.pose.residual_mm:.1f} mm off.",
    )


def _with_landmarks(
    result: Check,
    landmarks: Path,
    template: Template,
    samples: Samples,
    place: Placement,
    winding: list[Finding],
) -> list[Finding]:
    """Add what is wrong with the landmarks; return the winding's findings in their light.

    Landmarks are set on the scan as it is seen. If their sides are exchanged and the triangles
    face inwards too, it is the scan that is mirrored; if only the triangles do, it is not.
    """
    found = landmark_findings(landmarks, template, samples, place)
    swapped = any(finding.code == "landmarks.swapped" for finding in found)
    if not any(finding.code == "scan.mirrored" for finding in winding):
        result.findings += found
        return winding
    if swapped:
        message = "The scan is mirrored: its triangles face inwards, left and right are exchanged."
        return [Finding("scan.mirrored", "error", message)]
    result.findings += found
    return [finding for finding in winding if finding.code != "scan.mirrored"]


def _look_closer(
    result: Check,
    scan: RawScan,
    place: Placement,
    template: Template,
    face: Surface,
    role: str,
) -> None:
    """Add what the face lacks, its noise and spikes, its mouth and eyes."""
    points = samples_of(scan, FACE_SAMPLES)
    there = place.pose.apply(points.points)
    around = _around(there, face, AROUND_FACE_MM)
    near = Samples(points.points[around], points.normals[around], points.oriented)
    fitted = fit_likeness(near, place.pose, template, face)
    pose = fitted.pose
    size = place.mm_per_unit / pose.scale
    seen = cover(
        near.moved(pose.scale, pose.rotation, pose.translation), fitted.skin, template, face
    )
    vertices = pose.apply(scan.vertices)
    rough = roughness(vertices * size, seen.points[seen.covered] * size)
    marked = np.zeros(len(vertices), bool)
    if len(scan.faces):
        marked = spikes(vertices * size, scan.faces) & _around(vertices, face, AROUND_HEAD_MM)
    surface = Surface(vertices, scan.faces)
    features = Features(lip_gap(surface, template), closed_eyes(surface, fitted.skin, template))
    result.findings += cover_findings(seen, features)
    result.findings += roughness_findings(rough, int(marked.sum()))
    result.findings += feature_findings(features, role)
    result.cover = seen
    result.marked = marked
    result.figures |= {
        "covered": round(seen.share(), 3),
        "noise_mm": None if np.isnan(rough.noise_mm) else round(rough.noise_mm, 2),
        "spacing_mm": round(rough.spacing_mm, 2),
        "lip_gap_mm": features.lip_gap_mm,
        "spikes": int(marked.sum()),
    }


def _around(points: Floats, face: Surface, margin: float | Floats) -> NDArray[np.bool_]:
    """Return which points lie in the box about the face, larger by ``margin`` (below, above)."""
    below, above = np.broadcast_to(margin, (2, 3)) if np.ndim(margin) else (margin, margin)
    corners = face.vertices[np.unique(face.faces)]
    low, high = corners.min(axis=0) - below, corners.max(axis=0) + above
    return np.asarray(((points > low) & (points < high)).all(axis=1))
