"""Findings of a scan's check, each with a stable code, a plain sentence and advice.

Every code has one advice, in ``advice.csv``; ``docs/guide/scans.md`` lists the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.errors import MOST_NAMES, Finding, InputError, Severity, advise, count_words, quote
from solver.meshio.raw import WELDED_SHARE, Mending, RawScan
from solver.registration.landmarks import match, read_landmarks
from solver.registration.locate import Location
from solver.registration.scan_surface import Samples
from solver.registration.search import REFINEMENT, FacePoints
from solver.registration.units import ADVICE as UNIT_ADVICE
from solver.registration.units import choose_unit, given_unit
from solver.scans import read_advice
from solver.scans.cover import Cover
from solver.scans.mouth import Eye, MouthGaps
from solver.similarity import fit_similarity
from solver.surface import Floats

EXPORT_AGAIN = "Export the scan again from the scanner's software and send the new file."
ADVICE = read_advice("scan") | UNIT_ADVICE
make_finding = partial(advise, ADVICE)


def with_advice(finding: Finding) -> Finding:
    """Return the finding with the advice that belongs to its code."""
    return replace(finding, advice=ADVICE.get(finding.code, EXPORT_AGAIN))


def error_finding(error: InputError) -> Finding:
    """Return the finding of what made a scan unreadable."""
    return with_advice(Finding(error.code, "error", error.message, context=error.context))


# Findings about the face itself: what is missing, how rough it is, its mouth and its eyes.


@dataclass(frozen=True)
class ScanLimits:
    """Beyond these a scan has a finding: its face, and shares of its vertices or triangles."""

    hole_mm2: float = 180.0  # area of a hole
    cut_off_mm2: float = 500.0  # area missing at the rim
    least_cover: float = 0.7  # share of the face
    least_side: float = 0.6  # share of a side
    noise_mm: float = 0.5  # a warning
    much_noise_mm: float = 1.5  # more is an error
    coarse_mm: float = 2.5  # between vertices
    coarse_noise: float = 0.2  # more noise a mm of spacing: the quadratic misses folds
    spikes: int = 4  # vertices
    not_finite: float = 0.2  # vertices: an error
    flat: float = 0.0005  # triangles
    flipped: float = 0.005  # triangles
    unused: float = 0.2  # vertices
    touching: float = 0.005  # edges of three triangles where touching parts are joined
    dense: int = 400_000  # vertices, not a share


LIMITS = ScanLimits()


def cover_findings(cover: Cover) -> list[Finding]:
    """Return what is missing of a face: a side, its end, holes, or small gaps."""
    found = []
    worst = min(("left", "right", "upper", "lower"), key=cover.share)
    whole = cover.share()
    if whole < LIMITS.least_cover or cover.share(worst) < LIMITS.least_side:
        place = f"in the {worst} half" if worst in ("upper", "lower") else f"on the {worst} side"
        message = f"{1 - whole:.0%} of the face is missing, most of it {place}."
        found.append(make_finding("scan.coverage", "error", message, covered=round(whole, 3)))
    cut = [hole for hole in cover.holes if hole.at_rim and hole.area_mm2 > LIMITS.cut_off_mm2]
    if cut and not found:
        area = sum(hole.area_mm2 for hole in cut)
        regions = ", ".join(dict.fromkeys(hole.region for hole in cut))
        message = f"The scan ends before the face does: {area / 100:.0f} cm2 miss at the {regions}."
        found.append(make_finding("scan.cut_off", "warning", message, area_mm2=round(area)))
    holes = [hole for hole in cover.holes if not hole.at_rim and hole.area_mm2 > LIMITS.hole_mm2]
    if holes:
        number = "a hole" if len(holes) == 1 else f"{len(holes)} holes"
        area = holes[0].area_mm2 / 100
        region = holes[0].region
        message = f"The face has {number}; the largest, {area:.1f} cm2, is at the {region}."
        places = [{"region": h.region, "area_mm2": round(h.area_mm2)} for h in holes[:10]]
        found.append(make_finding("scan.holes", "warning", message, holes=places))
    small = [hole for hole in cover.holes if not any(hole is told for told in (*cut, *holes))]
    if small and whole >= LIMITS.least_cover:
        area = sum(hole.area_mm2 for hole in small)
        region = small[0].region
        number = "a small gap" if len(small) == 1 else f"{len(small)} small gaps"
        message = f"The face has {number}, {area / 100:.1f} cm2, at the {region}: red in check.png."
        found.append(make_finding("scan.gaps", "info", message, area_mm2=round(area)))
    return found


def roughness_findings(noise_mm: float, spacing_mm: float, spikes: int) -> list[Finding]:
    """Return whether a face is noisy, spiky or coarse."""
    found = []
    limit = LIMITS.noise_mm + LIMITS.coarse_noise * max(spacing_mm - 3.0, 0.0)
    if noise_mm > limit:
        severity: Severity = "error" if noise_mm > limit + LIMITS.much_noise_mm else "warning"
        message = f"The surface is noisy: {noise_mm:.1f} mm; a good scan has below 0.3 mm."
        figures = {"found": round(noise_mm, 2), "expected": LIMITS.noise_mm}
        found.append(make_finding("scan.noise", severity, message, **figures))
    if spacing_mm > LIMITS.coarse_mm:
        message = f"The scan is coarse: a vertex every {spacing_mm:.1f} mm on the face."
        figures = {"found": round(spacing_mm, 1), "expected": LIMITS.coarse_mm}
        found.append(make_finding("scan.coarse", "warning", message, **figures))
    if spikes:
        many = "spikes stick" if spikes > 1 else "spike sticks"
        message = f"{spikes} {many} out on or around the face: orange in check.png."
        severity = "warning" if spikes >= LIMITS.spikes else "info"
        found.append(make_finding("scan.spikes", severity, message, found=spikes))
    return found


def feature_findings(
    mouth: MouthGaps, eyes: dict[str, Eye], role: str, *, opens: bool = False
) -> list[Finding]:
    """Return whether the mouth is open or ``eyes`` are closed, which a neutral should not have.

    Lids are no more than a warning where registration ``opens`` them by the template's shapes. In a
    scan of unknown ``role`` both are only mentioned, in an expression not at all.
    """
    if role == "expression":
        return []
    severity: Severity = "error" if role == "neutral" else "info"
    found = []
    if mouth.is_open:
        message = f"The mouth is open: the lips are {mouth.lips_mm:.0f} mm apart"
        if mouth.teeth_mm:
            message += f", the teeth {mouth.teeth_mm:.0f} mm"
        figures = {"found": mouth.lips_mm, "teeth_mm": mouth.teeth_mm}
        found.append(make_finding("scan.mouth_open", severity, f"{message}.", **figures))
    closed = [side for side, eye in eyes.items() if eye.closed]
    if closed:
        both = len(closed) == 2
        message = "Both eyes are closed." if both else f"The {closed[0]} eye is closed."
        if opens and severity == "error":
            severity = "warning"
            message += " Registration opens the lids by the template's shape."
        found.append(make_finding("scan.eyes_closed", severity, message, eyes=closed))
    return found


# Findings about the file and its mesh, before anything is known of a face.


# What is counted in a file: the sentence, and its subject with a verb for one and for many.
COUNTED = {
    "scan.duplicate_vertices": (
        "{} exactly in the place of another.",
        ("vertex lies", "vertices lie"),
    ),
    "scan.zero_area_faces": ("{} no area.", ("triangle has", "triangles have")),
    "scan.repeated_faces": ("{} there twice.", ("triangle is", "triangles are")),
    "scan.unused_vertices": ("{} in no triangle.", ("vertex is", "vertices are")),
    "scan.non_manifold": ("At {} three or more triangles meet.", ("edge", "edges")),
    "scan.inconsistent_normals": (
        "{} the other way than the surface around.",
        ("triangle faces", "triangles face"),
    ),
}


def file_findings(raw: RawScan, mending: Mending) -> list[Finding]:
    """Return what is wrong with a scan as it was stored, given what was mended in it."""
    vertices = len(raw.vertices)
    triangles = max(len(raw.faces), 1)
    found: list[Finding] = []

    def add(code: str, severity: Severity, message: str, **figures: object) -> None:
        found.append(make_finding(code, severity, message, **figures))

    held = raw.format
    expected = raw.suffix_format
    if held != expected:
        message = (
            f"{raw.file} holds {held.upper()}, not {expected.upper()} as its suffix says; it was "
            "read as what it holds."
        )
        add("scan.wrong_extension", "warning", message, expected=expected, found=held)
    lost = mending.not_finite
    first = mending.first_not_finite
    if lost:
        severity: Severity = "error" if lost > LIMITS.not_finite * vertices else "warning"
        message = (
            f"{count_words(lost, 'vertex', 'vertices')} of {vertices} "
            f"{'is' if lost == 1 else 'are'} not a number; the first is vertex {first} "
            "(counted from 0)."
        )
        add("scan.nan", severity, message, vertex=first, found=lost)
    is_welded = mending.duplicate > WELDED_SHARE * vertices
    seams = held in ("glb", "stl")  # which cannot share vertices across a seam
    touches = held == "stl" or is_welded
    many_touch = mending.non_manifold >= LIMITS.touching * 1.5 * triangles
    flat = LIMITS.flat * triangles
    flipped = LIMITS.flipped * triangles
    counts = {
        "scan.duplicate_vertices": (mending.duplicate, is_welded and not seams),
        "scan.zero_area_faces": (mending.flat, mending.flat > flat),
        "scan.repeated_faces": (mending.repeated, mending.repeated > flat),
        "scan.unused_vertices": (mending.unused, mending.unused > LIMITS.unused * vertices),
        "scan.non_manifold": (mending.non_manifold, many_touch or not touches),
        "scan.inconsistent_normals": (mending.flipped, mending.flipped > flipped),
    }
    for code, (number, is_worth_a_look) in counts.items():
        if number:
            sentence, subjects = COUNTED[code]
            message = sentence.format(count_words(number, *subjects))
            add(code, "warning" if is_worth_a_look else "info", message, found=number)
    if raw.empty_groups:
        groups = len(raw.empty_groups)
        names = ", ".join(raw.empty_groups[:5])
        message = f"{count_words(groups, 'group holds', 'groups hold')} no triangle: {names}."
        add("scan.empty_groups", "warning", message, groups=list(raw.empty_groups[:MOST_NAMES]))
    if not len(raw.faces) and raw.normals is None:
        message = f"{raw.file} is a point cloud without normals; they are found from neighbours."
        add("scan.no_normals", "warning", message)
    if vertices > LIMITS.dense:
        message = f"{vertices:,} vertices are more than a registration can use."
        add("scan.dense", "warning", message, found=vertices, expected=LIMITS.dense)
    return found


OFF_SURFACE_MM = 6.0  # farther landmarks are of another scan, or in another unit


def landmark_findings(
    path: Path, template: Template, scan: RawScan, samples: Samples, frame: Mapping[str, Any]
) -> tuple[list[Finding], tuple[Floats, Floats] | None]:
    """Return what is wrong with the landmarks in ``path``; else their points and the template's.

    ``samples`` of the scan and the points (k, 3) are in the file's own frame.
    """
    try:
        points = read_landmarks(path)
        places, vertices = match(path.name, points, template)
    except InputError as error:
        return [error_finding(error)], None
    rest = template.skin.vertices[vertices]
    scale = fit_similarity(places, rest).scale
    unit = choose_unit(scale, given_unit(frame), scan.mm_per_unit)
    gap = samples.tree.query(np.array(list(points.values())))[0] * unit.mm_per_unit
    worst = int(np.argmax(gap))
    if gap[worst] <= OFF_SURFACE_MM:
        return [], (places, rest)
    name = quote(list(points)[worst])
    found = float(gap[worst])
    message = f"{path.name}: {name} lies {found:.0f} mm off the scan."
    figures = {"landmark": name, "found": found, "expected": OFF_SURFACE_MM}
    return [make_finding("landmarks.off_surface", "error", message, **figures)], None


MOST_INWARD = 0.8  # share of a face's triangles that face inwards: it is inside out
SOME_INWARD = 0.1  # share from which it is told


def axis_findings(place: Location, frame: Mapping[str, Any]) -> list[Finding]:
    """Return how the scan is turned against y up and z forward."""
    up = place.up
    forward = place.forward
    if frame["up"] != "auto" or (up, forward) == ("y", "z"):
        return []
    figures: dict[str, Any] = {"up": up, "forward": forward}
    if up in ("-y", "-z"):
        message = f"The head stands upside down: {up} of the file points to its top."
        figures["upright"] = float(place.motion.rotation[1, 1])
        return [make_finding("scan.upside_down", "warning", message, **figures)]
    message = f"{up} of the file points to the top of the head, {forward} forward."
    return [make_finding("scan.axes", "info", message, **figures)]


def winding_findings(
    scan: RawScan, samples: Samples, face: FacePoints, place: Location
) -> list[Finding]:
    """Return whether the triangles face inwards, which flipped normals and mirroring both do.

    Stored normals tell the two apart: mirroring turns them with the surface, but not the order of
    the triangles' corners.
    """
    if not samples.oriented:
        return []
    inward = _share_inward(samples, face, place)
    if inward < SOME_INWARD:
        return []
    figures = {"share": round(inward, 3)}
    part = "The whole" if inward >= MOST_INWARD else f"{inward:.0%} of the face's"
    message = f"{part} surface is inside out."
    inverted = make_finding("scan.inverted_normals", "warning", message, **figures)
    if inward < MOST_INWARD or not len(scan.faces):
        return [inverted]
    if scan.normals is None:
        message = (
            "The scan may be mirrored: its triangles face inwards, as mirroring makes them. "
            "Compare a mole or the parting with the person."
        )
        return [inverted, make_finding("scan.mirrored", "warning", message, **figures)]
    chosen = np.random.default_rng(0).permutation(len(scan.vertices))[:20000]
    stored = Samples(scan.vertices[chosen], np.nan_to_num(scan.normals[chosen]), True)
    if _share_inward(stored, face, place, unclear=1.0) >= 0.5:
        return [inverted]
    message = "The scan is mirrored: its triangles face inwards, its normals outwards."
    return [make_finding("scan.mirrored", "error", message, **figures)]


def _share_inward(
    samples: Samples, face: FacePoints, place: Location, unclear: float = 0.0
) -> float:
    """Return the share of the face's points whose closest sample faces the other way.

    It is ``unclear`` where none of them faces either way.
    """
    there = samples.transform(place.pose.motion)
    gap, near = there.tree.query(face.points)
    facing = (there.normals[near] * face.normals).sum(axis=1)
    clear = facing[(gap < REFINEMENT.close) & (np.abs(facing) > REFINEMENT.facing)]
    return float((clear < 0).mean()) if len(clear) else unclear
