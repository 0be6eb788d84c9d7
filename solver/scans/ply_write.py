"""Writing a mesh as binary PLY, exactly: coordinates in double precision."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from solver.surface import Floats, Surface

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_ply(path: Path, surface: Surface, values: Mapping[str, Floats] | None = None) -> None:
    """Write triangles as PLY; what is read back is equal.

    ``values`` are further properties of the vertices, name -> (n,), in single precision.
    """
    columns = {"x": "<f8", "y": "<f8", "z": "<f8", **dict.fromkeys(values or {}, "<f4")}
    vertices = np.empty(len(surface.vertices), dtype=list(columns.items()))
    for name, column in {
        **dict(zip("xyz", surface.vertices.T, strict=True)),
        **(values or {}),
    }.items():
        vertices[name] = column
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(surface.vertices)}\n"
        + "".join(
            f"property {'double' if code == '<f8' else 'float'} {name}\n"
            for name, code in columns.items()
        )
        + f"element face {len(surface.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(surface.faces), dtype=_FACE)
    faces["count"], faces["corners"] = 3, surface.faces
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
