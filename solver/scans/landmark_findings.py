"""Findings about landmarks that came with a scan: whether they belong to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.errors import InputError
from solver.scans.findings import Finding, of_error
from solver.scans.landmarks import match, read_landmarks
from solver.scans.sample import Samples
from solver.scans.units import Placement

OFF_SURFACE_MM = 6.0


def landmark_findings(
    path: Path, template: Template, scan: Samples, place: Placement
) -> list[Finding]:
    """Return what is wrong with the landmarks in ``path``; ``scan`` is in the file's own frame."""
    try:
        points = read_landmarks(path)
        match(path.name, points, template)
    except InputError as error:
        return [of_error(error)]
    gap = KDTree(scan.points).query(np.array(list(points.values())))[0] * place.mm_per_unit
    worst = int(np.argmax(gap))
    if gap[worst] <= OFF_SURFACE_MM:
        return []
    name = list(points)[worst]
    return [
        Finding(
            "landmarks.off_surface",
            "error",
            f"{path.name}: {name} lies {gap[worst]:.0f} mm off the scan.",
            {"landmark": name, "found": float(gap[worst]), "expected": OFF_SURFACE_MM},
        )
    ]
