"""A scan in the template's topology, and how far each of its vertices can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from solver.scans.ply_write import write_ply
from solver.surface import Floats, Surface

CONFIDENCE = "confidence"
"""The PLY property of the vertices."""


@dataclass(frozen=True)
class RegisteredScan:
    """``vertices`` (n, 3) in mm and their ``confidence`` (n,) in [0, 1], 0 where nothing was seen.

    A file that says nothing about confidence is trusted everywhere.
    """

    vertices: Floats
    confidence: Floats


def write_registered(path: Path, surface: Surface, confidence: Floats) -> None:
    """Write a registered scan as PLY; :func:`solver.scans.read.read_registered` reads it."""
    write_ply(path, surface, {CONFIDENCE: confidence})
