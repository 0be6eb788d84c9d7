"""Writing a mesh as binary PLY, exactly: coordinates in double precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.surface import Surface

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_ply(path: Path, surface: Surface) -> None:
    """Write triangles as PLY; what is read back is equal."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(surface.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(surface.faces), dtype=_FACE)
    faces["count"], faces["corners"] = 3, surface.faces
    path.write_bytes(header.encode() + surface.vertices.astype("<f8").tobytes() + faces.tobytes())
