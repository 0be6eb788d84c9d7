"""Whether a registered scan can be this person's head: scale, vertex order, alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.errors import InputError
from solver.surface import Floats, Ints

HEAD_MM = (100.0, 700.0)  # largest extent: from a bare face to a head with neck and shoulders
UNITS = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4}
MAX_EDGE_SHARE = 0.2  # median edge by largest extent; shuffled vertices give about 0.4
MAX_MEDIAN_MOTION_MM = 25.0  # a wide open jaw moves half of a bare face by about 10 mm

MIRRORED = 0.25
"""Part of a rotation's squared distances that a mirror image has to leave to be the better one."""


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
    One that is the neutral's mirror image rather than moved is ``scan.mirrored``.
    """
    motion = _rigid_motion(neutral, vertices)
    if motion.mirrored:
        raise InputError(
            "scan.mirrored",
            f"{file} is mirrored against the neutral (left and right exchanged, or inside out): "
            "switch off mirroring in the export",
            file=file,
        )
    median = float(np.median(np.linalg.norm(vertices - neutral, axis=1)))
    if median <= MAX_MEDIAN_MOTION_MM:
        return
    raise InputError(
        "scan.misaligned",
        f"{file} lies {median:.0f} mm off the neutral (median over all vertices): it is turned by "
        f"{motion.degrees:.0f} degrees and moved by {motion.shift:.0f} mm; align its skull with "
        "the neutral's",
        file=file,
        expected=MAX_MEDIAN_MOTION_MM,
        found=median,
    )


@dataclass(frozen=True)
class _Motion:
    """The best rigid motion, in degrees and mm, and whether a mirror image fits far better."""

    degrees: float
    shift: float
    mirrored: bool


def _rigid_motion(start: Floats, end: Floats) -> _Motion:
    """Return the best rigid motion of ``start`` (n, 3) onto ``end`` (Kabsch 1976)."""
    centred, goal = start - start.mean(0), end - end.mean(0)
    u, s, vt = np.linalg.svd(centred.T @ goal)
    sign = np.sign(np.linalg.det(u @ vt))
    cosine = (np.trace(u @ np.diag([1.0, 1.0, sign]) @ vt) - 1) / 2
    # what is left of the squared distances by a rotation, and by a mirrored one; a flat surface is
    # its own mirror image
    spread = np.sum(centred**2) + np.sum(goal**2)
    left = [spread - 2.0 * (s[0] + s[1] + side * s[2]) for side in (sign, -sign)]
    return _Motion(
        float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        float(np.linalg.norm(end.mean(0) - start.mean(0))),
        bool(left[1] < MIRRORED * left[0] and left[0] > 1e-3 * spread),
    )
