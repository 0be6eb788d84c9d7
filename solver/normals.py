"""Smooth normals."""

from __future__ import annotations

import igl
import numpy as np

from solver.surface import Floats, Surface


def vertex_normals(surface: Surface) -> Floats:
    """Return unit vertex normals (n, 3); a vertex without area gets (0, 0, 1)."""
    normals = np.asarray(igl.per_vertex_normals(surface.vertices, surface.faces))
    length = np.linalg.norm(normals, axis=1)
    flat = ~(length > 0.5)
    normals[flat] = (0.0, 0.0, 1.0)
    return normals / np.where(flat, 1.0, length)[:, None]
