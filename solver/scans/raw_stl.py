"""STL as a raw scan: loose triangles, joined where their corners are one place."""

from __future__ import annotations

from solver.scans.faults import empty
from solver.scans.mesh import Mesh
from solver.scans.stl import read_facets
from solver.scans.weld import weld


def read_raw_stl(file: str, content: bytes) -> Mesh:
    """Return the mesh of STL ``content`` (ascii or binary)."""
    corners = read_facets(file, content)
    if len(corners) == 0:
        raise empty(file)
    first, numbers = weld(corners.reshape(-1, 3))
    return Mesh(corners.reshape(-1, 3)[first], numbers.reshape(-1, 3))
