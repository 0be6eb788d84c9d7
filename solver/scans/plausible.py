"""Whether a registered scan can be this person's head: scale, vertex order, alignment."""

from __future__ import annotations

import numpy as np

from solver.errors import InputError
from solver.surface import Floats, Ints

HEAD_MM = (100.0, 700.0)  # largest extent: from a bare face to a head with neck and shoulders
UNITS = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4}
MAX_EDGE_SHARE = 0.2  # median edge by largest extent; shuffled vertices give about 0.4
MAX_MEDIAN_MOTION_MM = 25.0  # a wide open jaw moves half of a bare face by about 10 mm


def check_scale(file: str, vertices: Floats) -> None:
    """Raise ``scan.unit`` unless the vertices (n, 3) are as large as a head in mm."""
    with np.errstate(over="ignore"):
        extent = float(np.nan_to_num(np.ptp(vertices, axis=0).max()))
    low, high = HEAD_MM
    if low <= extent <= high:
        return
    guess = next((unit for unit, factor in UNITS.items() if low <= extent * factor <= high), None)
    if low <= extent / 1000 <= high:
        hint = "it seems to hold millimetres where the format's unit is the metre"
    elif guess is not None:
        hint = f"it seems to be in {guess}: scale it by {UNITS[guess]:g}"
    else:
        hint = "it can not be a head in mm"
    raise InputError(
        "scan.unit",
        f"{file} is {extent:.4g} mm across, a head is {low:g} to {high:g} mm; {hint}",
        file=file,
        expected=list(HEAD_MM),
        found=extent,
    )


def check_vertex_order(file: str, vertices: Floats, faces: Ints) -> None:
    """Raise ``scan.vertex_order`` if the template's faces (f, 3) join vertices far apart."""
    edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
    median, extent = float(np.median(edges)), float(np.ptp(vertices, axis=0).max())
    if median > MAX_EDGE_SHARE * extent:
        raise InputError(
            "scan.vertex_order",
            f"{file}: neighbours in the template lie {median:.3g} mm apart; "
            "the vertices are not in the template's order",
            file=file,
            found=median,
        )


def check_alignment(file: str, vertices: Floats, neutral: Floats) -> None:
    """Raise ``scan.misaligned`` if the expression (n, 3) is far off the neutral (n, 3).

    Scans of one session share the skull's place; the message says by how much this one is moved.
    """
    median = float(np.median(np.linalg.norm(vertices - neutral, axis=1)))
    if median <= MAX_MEDIAN_MOTION_MM:
        return
    degrees, shift = _rigid_motion(neutral, vertices)
    raise InputError(
        "scan.misaligned",
        f"{file} lies {median:.0f} mm off the neutral (median over all vertices): it is turned by "
        f"{degrees:.0f} degrees and moved by {shift:.0f} mm; align its skull with the neutral's",
        file=file,
        expected=MAX_MEDIAN_MOTION_MM,
        found=median,
    )


def _rigid_motion(start: Floats, end: Floats) -> tuple[float, float]:
    """Return the angle (degrees) and shift (mm) of the best rigid motion (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((start - start.mean(0)).T @ (end - end.mean(0)))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    cosine = (np.trace(u @ turn @ vt) - 1) / 2
    shift = np.linalg.norm(end.mean(0) - start.mean(0))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(shift)
