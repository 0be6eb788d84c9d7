"""Binary glTF 2.0 (GLB): every mesh the scene shows, each in its node's place.

The few fields that are needed are read here, because every one must be checked before it is
trusted, and a general loader's conveniences (merging, welding) would change the vertex order.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import quote
from solver.meshio.mesh import (
    NO_FACES,
    Mesh,
    empty_error,
    fan,
    join_meshes,
    truncated_error,
    unreadable_error,
    unsupported_error,
)
from solver.surface import Floats, Ints

MM_PER_METRE = 1000.0  # glTF's unit is the metre

# Numbers of the glTF 2.0 specification: types of components and accessors, modes of primitives.
FLOAT = 5126
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
JSON_CHUNK = b"JSON"
BINARY_CHUNK = b"BIN\0"

MAX_DEPTH = 64  # of nodes in nodes: no exporter comes near, and recursion stays within Python's
# Parts may share data, but all of them together are no larger than the greater of these.
MOST_SHARES = 16  # times the file
FEW_BYTES = 1 << 24  # of a small file
ACCESS_BYTES = 1 << 10  # that reading any accessor counts for at least
MOST = 1 << 53  # no count or offset: JSON's numbers end there
# by broken rules
NOT_VALID = (
    *(KeyError, IndexError, TypeError, AttributeError, OverflowError),
    np.linalg.LinAlgError,
)


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
    source = read_chunks(file, content)
    try:
        if strict:
            return _registered_mesh(source, source.shown_meshes())
        parts = [part for _, part in source.shown_parts()]
    except NOT_VALID as error:
        reason = f"the glTF description is not valid ({quote(repr(error))})"
        raise unreadable_error(file, reason) from None
    if not parts:
        raise empty_error(file)
    return join_meshes(parts)


@dataclass
class GlbSource:
    """A ``file``: its description, its binary buffer, and how many bytes may yet be read."""

    file: str
    document: dict[str, Any]
    binary: bytes
    left: int

    def item(self, kind: str, number: int) -> Any:
        """Return an object by its glTF number: Python's negative numbers mean nothing there."""
        if not isinstance(number, int) or number < 0:
            raise IndexError(number)
        return self.document[kind][number]

    def shown_meshes(self) -> list[tuple[dict[str, Any], Floats]]:
        """Return the meshes that the scene shows, with the (4, 4) transforms of their nodes."""
        found: list[tuple[dict[str, Any], Floats]] = []
        seen: set[int] = set()

        def visit(number: int, parent: Floats, depth: int) -> None:
            if depth > MAX_DEPTH or number in seen:
                raise unsupported_error(self.file, "the scene is not a tree of reasonable depth")
            seen.add(number)
            node = self.item("nodes", number)
            transform = parent @ _transform(self.file, node)
            if "mesh" in node:
                found.append((self.item("meshes", node["mesh"]), transform))
            for child in node.get("children", []):
                visit(child, transform, depth + 1)

        for root in self.item("scenes", self.document.get("scene", 0)).get("nodes", []):
            visit(root, np.eye(4), 0)
        return found

    def shown_parts(self) -> Iterator[tuple[dict[str, Any], Mesh]]:
        """Yield the primitives of the shown meshes, each as a mesh in its node's place."""
        for mesh, transform in self.shown_meshes():
            name = quote(mesh.get("name", "mesh"))
            for number, primitive in enumerate(mesh["primitives"]):
                part = _part(self, primitive, f"{name}[{number}]")
                yield primitive, _place(part, transform)

    def positions(self, number: int) -> Floats:
        """Return the positions (n, 3) of accessor ``number``."""
        accessor = self.item("accessors", number)
        if accessor["type"] != "VEC3" or accessor["componentType"] != FLOAT:
            raise unsupported_error(self.file, "the positions are not stored as 32-bit floats")
        positions = self.rows(number)
        if not len(positions):
            raise empty_error(self.file)
        return positions.astype(np.float64)

    def unit_rows(self, number: int) -> Floats:
        """Return the rows of accessor ``number``, whole numbers as parts of the greatest."""
        stored = self.rows(number)
        scale = 1 if stored.dtype.kind == "f" else int(np.iinfo(str(stored.dtype)).max)
        return np.asarray(stored, np.float64) / scale

    def view(self, number: int) -> bytes:
        """Return the bytes of buffer view ``number``."""
        view = self.item("bufferViews", number)
        start = view.get("byteOffset", 0)
        length = view["byteLength"]
        if not all(isinstance(each, int) and 0 <= each < MOST for each in (start, length)):
            raise unreadable_error(self.file, "the counts and offsets of the data are not valid")
        if start + length > len(self.binary):
            raise truncated_error(self.file, f"the data need {start + length} bytes")
        return self.binary[start : start + length]

    def rows(self, number: int) -> NDArray[np.generic]:
        """Return the rows (n, width) of accessor ``number`` as they are stored."""
        accessor = self.item("accessors", number)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise unsupported_error(self.file, "sparse or compressed data are not supported")
        view = self.item("bufferViews", accessor["bufferView"])
        if self.item("buffers", view["buffer"]).get("uri") is not None:
            raise unsupported_error(self.file, "the data lie in another file")
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        size = kind.itemsize * width
        count = accessor["count"]
        stride = view.get("byteStride", size)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        numbers = count, stride, start
        if not all(isinstance(number, int) and 0 <= number < MOST for number in numbers):
            raise unreadable_error(self.file, "the counts and offsets of the data are not valid")
        if count == 0:
            return np.zeros((0, width), kind)
        expected = start + (count - 1) * stride + size
        found = len(self.binary)
        if stride < size or expected > found:
            reason = f"the data need {expected} bytes, found {found}"
            raise truncated_error(self.file, reason, expected=expected, found=found)
        self.left -= count * size + ACCESS_BYTES
        if self.left < 0:
            reason = f"its parts share data and are {MOST_SHARES} times as large as the file"
            raise unsupported_error(self.file, reason)
        return np.ndarray((count, width), kind, self.binary, start, (stride, kind.itemsize))


def read_chunks(file: str, content: bytes) -> GlbSource:
    """Return the description and the binary buffer of a GLB file."""
    if not content:
        raise empty_error(file)
    if content[:4] != b"glTF" or content[4:8] != (2).to_bytes(4, "little"):
        raise unreadable_error(file, "not a binary glTF 2.0 file")
    length = int.from_bytes(content[8:12], "little")
    found = len(content)
    if found < length or found < 20:
        reason = f"the header announces {length} bytes, found {found}"
        raise truncated_error(file, reason, expected=length, found=found)
    parts: dict[bytes, bytes] = {}
    position = 12
    while position + 8 <= length:
        size = int.from_bytes(content[position : position + 4], "little")
        kind = content[position + 4 : position + 8]
        if position + 8 + size > length:
            raise truncated_error(file, f"a chunk of {size} bytes runs past the end of the file")
        parts.setdefault(kind, content[position + 8 : position + 8 + size])
        position += 8 + size
    try:
        document = json.loads(parts.get(JSON_CHUNK, b""))
    except (ValueError, RecursionError):
        raise unreadable_error(file, "the description is not valid JSON") from None
    if not isinstance(document, dict):
        raise unreadable_error(file, "the description is not a JSON object")
    binary = parts.get(BINARY_CHUNK, b"")
    return GlbSource(file, document, binary, max(MOST_SHARES * len(content), FEW_BYTES))


def _transform(file: str, node: dict[str, Any]) -> Floats:
    """Return the (4, 4) transform of a node: its matrix, or rotation, scale and translation."""
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


def _registered_mesh(source: GlbSource, shown: list[tuple[dict[str, Any], Floats]]) -> Mesh:
    """Return the vertices of the one mesh that the scene shows."""
    file = source.file
    if len(shown) != 1:
        reason = f"the scene must show exactly one mesh, found {len(shown)}"
        raise unsupported_error(file, reason)
    mesh, transform = shown[0]
    positions = {part["attributes"]["POSITION"] for part in mesh["primitives"]}
    if len(positions) != 1:
        raise unsupported_error(file, "the parts of the mesh do not share one list of positions")
    return _place(Mesh(source.positions(positions.pop())), transform)


def _part(source: GlbSource, primitive: dict[str, Any], name: str) -> Mesh:
    """Return a primitive as a mesh; ``name`` is its own."""
    attributes = primitive["attributes"]
    mode = primitive.get("mode", Mode.TRIANGLES)
    vertices = source.positions(attributes["POSITION"])
    corners: Ints = np.arange(len(vertices), dtype=np.int64)
    if "indices" in primitive:
        corners = source.rows(primitive["indices"]).ravel().astype(np.int64)
    faces = _triangles(source.file, corners, mode)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        found = int(faces.max())
        expected = len(vertices)
        reason = f"{name} uses vertex {found}, but there are {expected}"
        raise unreadable_error(source.file, reason, expected=expected, found=found)

    def rows(attribute: str) -> Floats | None:
        if attribute not in attributes:
            return None
        values = source.unit_rows(attributes[attribute])[:, :3]
        if values.shape != vertices.shape:
            raise unreadable_error(source.file, f"{attribute} of {name} does not fit its positions")
        return values

    empty = (name,) if len(faces) == 0 and mode != Mode.POINTS else ()
    return Mesh(vertices, faces, rows("NORMAL"), rows("COLOR_0"), empty_groups=empty)


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
        return fan(corners, np.array([len(corners)]))
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
