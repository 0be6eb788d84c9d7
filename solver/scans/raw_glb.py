"""Binary glTF 2.0 as a raw scan: every mesh the scene shows, each in its node's place."""

from __future__ import annotations

from typing import Any

import numpy as np

from solver.scans.faults import empty, unreadable, unsupported
from solver.scans.glb import (
    NOT_VALID,
    read_accessor,
    read_chunks,
    read_positions,
    shown_meshes,
)
from solver.scans.mesh import NO_FACES, Mesh, joined
from solver.surface import Floats, Ints

POINTS, TRIANGLES, STRIP, FAN = 0, 4, 5, 6


def read_raw_glb(file: str, content: bytes) -> Mesh:
    """Return the meshes of GLB ``content`` as one, in metres as glTF demands."""
    document, binary = read_chunks(file, content)
    parts = []
    try:
        for mesh, transform in shown_meshes(file, document):
            for number, primitive in enumerate(mesh["primitives"]):
                name = f"{mesh.get('name', 'mesh')}[{number}]"
                parts.append(_placed(_part(file, document, binary, primitive, name), transform))
    except NOT_VALID as error:
        raise unreadable(file, f"the glTF description is not valid ({error!r})") from None
    if not parts:
        raise empty(file)
    return joined(parts)


def _part(
    file: str, document: dict[str, Any], binary: bytes, primitive: dict[str, Any], name: str
) -> Mesh:
    attributes = primitive["attributes"]
    vertices = read_positions(file, document, binary, attributes["POSITION"])
    mode = primitive.get("mode", TRIANGLES)
    if "indices" in primitive:
        indices = read_accessor(file, document, binary, primitive["indices"])
        corners: Ints = indices.ravel().astype(np.int64)
    else:
        corners = np.arange(len(vertices), dtype=np.int64)
    faces = _triangles(file, corners, mode)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise unreadable(
            file,
            f"{name} uses vertex {faces.max()}, but there are {len(vertices)}",
            expected=len(vertices),
            found=int(faces.max()),
        )

    def rows(attribute: str) -> Floats | None:
        if attribute not in attributes:
            return None
        stored = read_accessor(file, document, binary, attributes[attribute])
        scale = 1 if stored.dtype.kind == "f" else int(np.iinfo(str(stored.dtype)).max)
        values = np.asarray(stored[:, :3], np.float64) / scale
        if values.shape != vertices.shape:
            raise unreadable(file, f"{attribute} of {name} does not fit its positions")
        return values

    is_empty = len(faces) == 0 and mode != POINTS
    return Mesh(vertices, faces, rows("NORMAL"), rows("COLOR_0"), (name,) if is_empty else ())


def _triangles(file: str, corners: Ints, mode: int) -> Ints:
    if mode == POINTS:
        return NO_FACES
    if mode == TRIANGLES:
        if len(corners) % 3:
            raise unreadable(file, f"{len(corners)} corners do not make whole triangles")
        return corners.reshape(-1, 3)
    if mode == STRIP:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    if mode == FAN:
        first = np.full(max(len(corners) - 2, 0), corners[0])
        return np.stack([first, corners[1:-1], corners[2:]], axis=1)
    raise unsupported(file, "lines are no surface: export triangles")


def _placed(mesh: Mesh, transform: Floats) -> Mesh:
    """Return the mesh moved by a (4, 4) transform; a mirroring node turns its triangles round."""
    linear = transform[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    normals = mesh.normals
    if normals is not None:
        normals = normals @ np.linalg.pinv(linear)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
    return Mesh(
        mesh.vertices @ linear.T + transform[:3, 3],
        mesh.faces[:, ::-1] if mirrored else mesh.faces,
        normals,
        mesh.colours,
        mesh.empty_groups,
    )
