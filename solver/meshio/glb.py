"""Binary glTF 2.0 (GLB): every mesh the scene shows, each in its node's place.

The few fields that are needed are read here, because every one must be checked before it is
trusted, and a general loader's conveniences (merging, welding) would change the vertex order.
"""

from __future__ import annotations

import json
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.meshio.faults import empty_error, truncated_error, unreadable_error, unsupported_error
from solver.meshio.mesh import NO_FACES, Mesh, join_meshes
from solver.surface import Floats, Ints

MM_PER_METRE = 1000.0  # glTF's unit is the metre

# Numbers of the glTF 2.0 specification: types of components and accessors, modes of primitives.
FLOAT = 5126
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"

MAX_DEPTH = 64  # of nodes in nodes: no exporter comes near, and recursion stays within Python's
NOT_VALID = (KeyError, IndexError, TypeError, AttributeError, OverflowError)  # by broken rules


class Mode(IntEnum):
    """Meanings of a primitive's corners that are no lines."""

    POINTS = 0
    TRIANGLES = 4
    STRIP = 5
    FAN = 6


def read_glb(file: str, content: bytes, *, strict: bool = False) -> Mesh:
    """Return what the scene of GLB ``content`` shows as one mesh, in metres.

    The transforms of nodes are applied. For registered scans (``strict``) the scene must show one
    mesh, whose parts share one list of positions; only these are returned, in the order of the
    file.
    """
    document, binary = read_chunks(file, content)
    try:
        shown = shown_meshes(file, document)
        if strict:
            return _registered_mesh(file, document, binary, shown)
        parts = []
        for mesh, transform in shown:
            for number, primitive in enumerate(mesh["primitives"]):
                name = f"{mesh.get('name', 'mesh')}[{number}]"
                parts.append(_place(_part(file, document, binary, primitive, name), transform))
    except NOT_VALID as error:
        raise _invalid_error(file, error) from None
    if not parts:
        raise empty_error(file)
    return join_meshes(parts)


def _invalid_error(file: str, error: Exception) -> InputError:
    return unreadable_error(file, f"the glTF description is not valid ({error!r})")


def _registered_mesh(
    file: str, document: dict[str, Any], binary: bytes, shown: list[tuple[dict[str, Any], Floats]]
) -> Mesh:
    """Return the vertices of the one mesh that the scene shows."""
    if len(shown) != 1:
        reason = f"the scene must show exactly one mesh, found {len(shown)}"
        raise unsupported_error(file, reason)
    mesh, transform = shown[0]
    positions = {part["attributes"]["POSITION"] for part in mesh["primitives"]}
    if len(positions) != 1:
        reason = "the parts of the mesh do not share one list of positions"
        raise unsupported_error(file, reason)
    vertices = read_positions(file, document, binary, positions.pop())
    return _place(Mesh(vertices), transform)


def read_chunks(file: str, content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary buffer of a GLB file."""
    if not content:
        raise empty_error(file)
    if content[:4] != b"glTF" or content[4:8] != (2).to_bytes(4, "little"):
        raise unreadable_error(file, "not a binary glTF 2.0 file")
    length = int.from_bytes(content[8:12], "little")
    if len(content) < length or len(content) < 20:
        raise truncated_error(
            file,
            f"the header announces {length} bytes, found {len(content)}",
            expected=length,
            found=len(content),
        )
    parts: dict[bytes, bytes] = {}
    position = 12
    while position + 8 <= len(content):
        size = int.from_bytes(content[position : position + 4], "little")
        kind = content[position + 4 : position + 8]
        if position + 8 + size > len(content):
            raise truncated_error(file, f"a chunk of {size} bytes runs past the end of the file")
        parts.setdefault(kind, content[position + 8 : position + 8 + size])
        position += 8 + size
    try:
        document = json.loads(parts.get(JSON_CHUNK, b""))
    except (ValueError, RecursionError):
        raise unreadable_error(file, "the description is not valid JSON") from None
    if not isinstance(document, dict):
        raise unreadable_error(file, "the description is not a JSON object")
    return document, parts.get(BINARY_CHUNK, b"")


def shown_meshes(file: str, document: dict[str, Any]) -> list[tuple[dict[str, Any], Floats]]:
    """Return the meshes that the scene shows, with the (4, 4) transforms of their nodes."""
    found: list[tuple[dict[str, Any], Floats]] = []
    seen: set[int] = set()

    def visit(number: int, parent: Floats, depth: int) -> None:
        if depth > MAX_DEPTH or number in seen:
            raise unsupported_error(file, "the scene is not a tree of reasonable depth")
        seen.add(number)
        node = _item(document["nodes"], number)
        transform = parent @ _transform(file, node)
        if "mesh" in node:
            found.append((_item(document["meshes"], node["mesh"]), transform))
        for child in node.get("children", []):
            visit(child, transform, depth + 1)

    for root in _item(document["scenes"], document.get("scene", 0))["nodes"]:
        visit(root, np.eye(4), 0)
    return found


def _item(items: list[Any], number: int) -> Any:
    """Return an item by its glTF number: Python's negative numbers mean nothing there."""
    if not isinstance(number, int) or number < 0:
        raise IndexError(number)
    return items[number]


def _transform(file: str, node: dict[str, Any]) -> Floats:
    try:
        if "matrix" in node:
            return np.array(node["matrix"], np.float64).reshape(4, 4).T
        x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        transform = np.eye(4)
        transform[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
        transform[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    except ValueError:
        raise unreadable_error(file, "the transform of a node is not valid") from None
    return transform


def read_positions(file: str, document: dict[str, Any], binary: bytes, number: int) -> Floats:
    """Return the positions (n, 3) of accessor ``number``."""
    accessor = _item(document["accessors"], number)
    if accessor["type"] != "VEC3" or accessor["componentType"] != FLOAT:
        raise unsupported_error(file, "the positions are not stored as 32-bit floats")
    positions = read_accessor(file, document, binary, number)
    if len(positions) == 0:
        raise empty_error(file)
    return positions.astype(np.float64)


def read_accessor(
    file: str, document: dict[str, Any], binary: bytes, number: int
) -> NDArray[np.generic]:
    """Return the rows (n, width) of accessor ``number`` as they are stored."""
    accessor = _item(document["accessors"], number)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise unsupported_error(file, "sparse or compressed data are not supported")
    view = _item(document["bufferViews"], accessor["bufferView"])
    if _item(document["buffers"], view["buffer"]).get("uri") is not None:
        raise unsupported_error(file, "the data lie in another file")
    kind, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
    size = kind.itemsize * width
    count, stride = accessor["count"], view.get("byteStride", size)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if not all(isinstance(value, int) and value >= 0 for value in (count, stride, start)):
        raise unreadable_error(file, "the counts and offsets of the data are not valid")
    if count == 0:
        return np.zeros((0, width), kind)
    expected = start + (count - 1) * stride + size
    if stride < size or expected > len(binary):
        raise truncated_error(
            file,
            f"the data need {expected} bytes, found {len(binary)}",
            expected=expected,
            found=len(binary),
        )
    return np.ndarray((count, width), kind, binary, start, (stride, kind.itemsize))


def _part(
    file: str, document: dict[str, Any], binary: bytes, primitive: dict[str, Any], name: str
) -> Mesh:
    attributes = primitive["attributes"]
    vertices = read_positions(file, document, binary, attributes["POSITION"])
    mode = primitive.get("mode", Mode.TRIANGLES)
    if "indices" in primitive:
        indices = read_accessor(file, document, binary, primitive["indices"])
        corners: Ints = indices.ravel().astype(np.int64)
    else:
        corners = np.arange(len(vertices), dtype=np.int64)
    faces = _triangles(file, corners, mode)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise unreadable_error(
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
            raise unreadable_error(file, f"{attribute} of {name} does not fit its positions")
        return values

    is_empty = len(faces) == 0 and mode != Mode.POINTS
    return Mesh(
        vertices, faces, rows("NORMAL"), rows("COLOR_0"), empty_groups=(name,) if is_empty else ()
    )


def _triangles(file: str, corners: Ints, mode: int) -> Ints:
    if mode == Mode.POINTS:
        return NO_FACES
    if mode == Mode.TRIANGLES:
        if len(corners) % 3:
            raise unreadable_error(file, f"{len(corners)} corners do not make whole triangles")
        return corners.reshape(-1, 3)
    if mode == Mode.STRIP:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    if mode == Mode.FAN:
        first = np.full(max(len(corners) - 2, 0), corners[0])
        return np.stack([first, corners[1:-1], corners[2:]], axis=1)
    raise unsupported_error(file, "lines are no surface: export triangles")


def _place(mesh: Mesh, transform: Floats) -> Mesh:
    """Return the mesh moved by a (4, 4) transform; a mirroring node turns its triangles round."""
    linear = transform[:3, :3]
    normals = mesh.normals
    with np.errstate(all="ignore"):  # what overflows is refused as not finite by the caller
        mirrored = np.linalg.det(linear) < 0
        vertices = np.asarray(mesh.vertices @ linear.T + transform[:3, 3])
        if normals is not None:
            normals = normals @ np.linalg.pinv(linear)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
    faces = mesh.faces[:, ::-1] if mirrored else mesh.faces
    return replace(mesh, vertices=vertices, faces=faces, normals=normals)
