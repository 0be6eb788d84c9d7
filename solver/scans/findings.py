"""What a check of a scan says: findings with a stable code, a plain sentence and advice.

Every code has one advice, here, so that the whole of what operators are told can be read in one
place; ``docs/scans.md`` lists the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from solver.errors import InputError

Severity = Literal["info", "warning", "error"]
Verdict = Literal["good", "usable", "bad"]

EXPORT_AGAIN = "Export the scan again from the scanner's software and send the new file."
ADVICE = {
    # the file
    "scan.format": "Export the scan as OBJ, PLY, STL, GLB or XYZ.",
    "scan.wrong_extension": "Give the file the suffix of what it holds, or export it again.",
    "scan.too_large": "Reduce the scan to about 200,000 vertices in the scanner's software.",
    "scan.empty": EXPORT_AGAIN,
    "scan.unreadable": EXPORT_AGAIN,
    "scan.truncated": "Copy or upload the file again; it was cut off on the way.",
    # the mesh
    "scan.nan": "Nothing to do: these vertices are left out. If they are many, export again.",
    "scan.duplicate_vertices": "Nothing to do: they are joined.",
    "scan.zero_area_faces": "Nothing to do: they are left out.",
    "scan.repeated_faces": "Nothing to do: they are left out.",
    "scan.unused_vertices": "Check that the file is whole: triangles seem to be missing.",
    "scan.non_manifold": "Nothing to do, but look at the marked places in the picture.",
    "scan.inconsistent_normals": "Nothing to do: the triangles are turned the same way round.",
    "scan.inverted_normals": "Nothing to do: the surface is turned inside out.",
    "scan.mirrored": "Switch off mirroring in the scanner's export and send the scan again.",
    "scan.empty_groups": "Nothing to do, if no part of the face is missing in the picture.",
    "scan.no_normals": "Send a mesh rather than points if you can; it registers more surely.",
    "scan.dense": "Nothing to do: it is thinned. About 200,000 vertices upload faster.",
    "scan.coarse": "Export the scan at a higher resolution: a vertex every 1 to 2 mm.",
    # unit and axes
    "scan.scale": "Check the unit shown; if it is wrong, give the right one and check again.",
    "scan.unit_unknown": "Say which unit the file is in (mm, cm, m or inch) and check again.",
    "scan.axes": "Nothing to do: the scan is turned.",
    "scan.upside_down": "Nothing to do: the scan is turned. Next time, scan the right way up.",
    # what is in it
    "scan.not_a_face": "Look at the picture: aim the scanner at the face and scan again.",
    "scan.half_face": "Scan again from both sides, so that both cheeks and ears are seen.",
    "scan.two_heads": "Cut the other person out of the scan, or scan one person alone.",
    "scan.coverage": "Scan again, and cover the side that is missing.",
    "scan.cut_off": "Scan again if skin is missing; hair before forehead and temples is no harm.",
    "scan.holes": "Scan again if a hole lies where the face moves: brows, cheeks, lips, chin.",
    "scan.noise": "Let the person hold still, more light, closer; then scan again.",
    "scan.spikes": "Nothing to do if they lie in the hair; cut them off if they lie on the face.",
    "scan.mouth_open": "If this is the neutral, scan again: lips closed, teeth apart, relaxed.",
    "scan.eyes_closed": "If this is the neutral, scan again with the eyes open.",
    # landmarks
    "landmarks.swapped": "Swap the names of the left and right landmarks: left is the subject's.",
    "landmarks.misplaced": "Set this landmark again, or leave it out.",
    "landmarks.unknown": "Use the names that the message lists.",
    "landmarks.unreadable": "Send landmarks as name, x, y, z in JSON or CSV.",
    "landmarks.format": "Send landmarks as name, x, y, z in JSON or CSV.",
    "landmarks.off_surface": "Check that the landmarks belong to this scan, in the same unit.",
}


@dataclass(frozen=True)
class Finding:
    """One thing about a scan that the operator should know.

    ``figures`` are numbers or names, as plain JSON values, that say where and how much.
    """

    code: str
    severity: Severity
    message: str
    figures: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as plain JSON values."""
        return {
            "code": self.code,
            "severity": self.severity,
            "message": self.message,
            "advice": ADVICE.get(self.code, EXPORT_AGAIN),
            **self.figures,
        }


def of_error(error: InputError) -> Finding:
    """Return the finding of what made a scan unreadable."""
    return Finding(error.code, "error", error.message, error.context)


def verdict(findings: list[Finding]) -> Verdict:
    """Return ``bad`` with any error, ``usable`` with any warning, else ``good``."""
    severities = {finding.severity for finding in findings}
    if "error" in severities:
        return "bad"
    return "usable" if "warning" in severities else "good"
