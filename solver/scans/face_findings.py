"""Findings about the face itself: what is missing, how rough it is, its mouth and its eyes."""

from __future__ import annotations

from dataclasses import dataclass

from solver.scans.cover import Cover
from solver.scans.findings import Finding, Severity
from solver.scans.roughness import Roughness

HOLE_MM2, CUT_OFF_MM2 = 180.0, 500.0
LEAST_COVER, LEAST_SIDE = 0.7, 0.6
NOISE_MM, MUCH_NOISE_MM = 0.5, 1.5
COARSE_MM = 6.0
COARSE_NOISE = 0.2
"""A coarse scan is that much rougher, by its spacing: the quadratic misses folds of the skin."""
MANY_SPIKES = 4
LIPS_APART_MM = 3.0


@dataclass(frozen=True)
class Features:
    """Mouth and eyes: the gap between the lips in mm and which eyes are surely closed."""

    lip_gap_mm: float
    closed: dict[str, bool]


def cover_findings(cover: Cover, features: Features) -> list[Finding]:
    """Return what is missing of a face: a side, its end, or holes; open lips are no hole."""
    found = []
    shares = {side: cover.share(side) for side in ("left", "right", "upper", "lower")}
    worst = min(shares, key=lambda side: shares[side])
    whole = cover.share()
    if whole < LEAST_COVER or shares[worst] < LEAST_SIDE:
        message = f"{1 - whole:.0%} of the face is missing, most of it on the {worst} side."
        if worst in ("upper", "lower"):
            message = f"{1 - whole:.0%} of the face is missing, most of it in the {worst} half."
        found.append(Finding("scan.coverage", "error", message, {"covered": round(whole, 3)}))
    cut = [hole for hole in cover.holes if hole.at_rim and hole.area_mm2 > CUT_OFF_MM2]
    if cut and not found:
        area = sum(hole.area_mm2 for hole in cut)
        regions = ", ".join(dict.fromkeys(hole.region for hole in cut))
        message = f"The scan ends before the face does: {area / 100:.0f} cm2 miss at the {regions}."
        found.append(Finding("scan.cut_off", "warning", message, {"area_mm2": round(area)}))
    holes = [hole for hole in cover.holes if not hole.at_rim and hole.area_mm2 > HOLE_MM2]
    if features.lip_gap_mm >= LIPS_APART_MM:  # a rough fit may have the chin where the mouth is
        holes = [hole for hole in holes if not hole.region.endswith(("lip", "chin"))]
    if holes:
        largest = holes[0]
        number = "a hole" if len(holes) == 1 else f"{len(holes)} holes"
        message = (
            f"The face has {number}; the largest, {largest.area_mm2 / 100:.1f} cm2, is at the "
            f"{largest.region}."
        )
        places = [{"region": h.region, "area_mm2": round(h.area_mm2)} for h in holes[:10]]
        found.append(Finding("scan.holes", "warning", message, {"holes": places}))
    return found


def roughness_findings(rough: Roughness, spikes: int) -> list[Finding]:
    """Return whether a face is noisy, spiky or coarse."""
    found = []
    limit = NOISE_MM + COARSE_NOISE * max(rough.spacing_mm - 3.0, 0.0)
    if rough.noise_mm > limit:
        severity: Severity = "error" if rough.noise_mm > limit + MUCH_NOISE_MM else "warning"
        message = f"The surface is noisy: {rough.noise_mm:.1f} mm; a good scan has below 0.3 mm."
        figures = {"found": round(rough.noise_mm, 2), "expected": NOISE_MM}
        found.append(Finding("scan.noise", severity, message, figures))
    if rough.spacing_mm > COARSE_MM:
        message = f"The scan is coarse: a vertex every {rough.spacing_mm:.0f} mm on the face."
        figures = {"found": round(rough.spacing_mm, 1), "expected": COARSE_MM}
        found.append(Finding("scan.coarse", "warning", message, figures))
    if spikes >= MANY_SPIKES:
        message = f"{spikes} spikes stick out on or around the face."
        found.append(Finding("scan.spikes", "warning", message, {"found": spikes}))
    return found


def feature_findings(features: Features, role: str) -> list[Finding]:
    """Return whether the mouth is open or the eyes are closed, which a neutral may not have.

    In a scan of unknown ``role`` they are only mentioned, in an expression not at all.
    """
    if role == "expression":
        return []
    severity: Severity = "error" if role == "neutral" else "info"
    found = []
    if features.lip_gap_mm >= LIPS_APART_MM:
        message = f"The mouth is open: the lips are {features.lip_gap_mm:.0f} mm apart."
        figures = {"found": features.lip_gap_mm}
        found.append(Finding("scan.mouth_open", severity, message, figures))
    closed = [side for side, is_closed in features.closed.items() if is_closed]
    if closed:
        both = len(closed) == 2
        message = "Both eyes are closed." if both else f"The {closed[0]} eye is closed."
        found.append(Finding("scan.eyes_closed", severity, message, {"eyes": closed}))
    return found
