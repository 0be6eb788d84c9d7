"""Structural checks of a ``rig.glb``, for places without the Khronos validator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

# glTF component type -> dtype
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# glTF type -> numbers an element
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def validate_glb(path: Path, names: list[str]) -> list[str]:
    """Return what is wrong with the rig in ``path``; nothing if all is well.

    Checked are the container, every accessor (bounds of memory, finite values, min and max), the
    triangles' indices, the morph targets ``names`` in order, and the animation of their weights.
    """
    content = path.read_bytes()
    if content[:4] != b"glTF" or len(content) < 20:
        return ["not a binary glTF file"]
    if int.from_bytes(content[8:12], "little") != len(content):
        return ["the header's length is not the file's"]
    json_bytes = int.from_bytes(content[12:16], "little")
    binary = content[20 + json_bytes + 8 :]
    try:
        document = json.loads(content[20 : 20 + json_bytes])
        values = [_values(document, binary, accessor) for accessor in document["accessors"]]
        return [
            *_accessor_faults(document, values),
            *_mesh_faults(document, values, names),
            *_animation_faults(document, values, len(names)),
        ]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return [f"the description does not fit the data: {error!r}"]


def _values(document: dict[str, Any], binary: bytes, accessor: dict[str, Any]) -> np.ndarray:
    width = WIDTHS[accessor["type"]]
    kind = COMPONENTS[accessor["componentType"]]
    values = np.zeros((accessor["count"], width), kind)
    if "bufferView" in accessor:
        values = _read_view(document, binary, accessor["bufferView"], kind, values.shape)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        place = sparse["indices"]
        index_kind = COMPONENTS[place["componentType"]]
        count = sparse["count"]
        rows = _read_view(document, binary, place["bufferView"], index_kind, (count,))
        if (np.diff(rows.astype(np.int64)) <= 0).any():
            raise ValueError("sparse indices do not increase")
        values[rows] = _read_view(
            document, binary, sparse["values"]["bufferView"], kind, (count, width)
        )
    return values


def _read_view(
    document: dict[str, Any], binary: bytes, view: int, kind: str, shape: tuple[int, ...]
) -> np.ndarray:
    place = document["bufferViews"][view]
    start, size = place.get("byteOffset", 0), place["byteLength"]
    if start % np.dtype(kind).itemsize:
        raise ValueError(f"bufferView {view} is not aligned")
    return np.frombuffer(binary[start : start + size], kind).reshape(shape)


def _accessor_faults(document: dict[str, Any], values: list[np.ndarray]) -> list[str]:
    faults = []
    for number, (accessor, table) in enumerate(zip(document["accessors"], values, strict=True)):
        if not np.isfinite(table).all():
            faults.append(f"accessor {number} holds what is not finite")
        for name, bound in (("min", table.min(axis=0)), ("max", table.max(axis=0))):
            if name in accessor and not np.array_equal(bound, np.float32(accessor[name])):
                faults.append(f"accessor {number} states another {name} than it has")
    return faults


def _mesh_faults(document: dict[str, Any], values: list[np.ndarray], names: list[str]) -> list[str]:
    faults = []
    mesh = document["meshes"][0]
    if mesh.get("extras", {}).get("targetNames", []) != names:
        faults.append("the morph targets are not named as the expressions")
    for number, part in enumerate(mesh["primitives"]):
        positions = values[part["attributes"]["POSITION"]]
        if values[part["indices"]].max() >= len(positions):
            faults.append(f"primitive {number} uses a vertex that is not there")
        if len(part.get("targets", [])) != len(names):
            faults.append(f"primitive {number} does not have {len(names)} morph targets")
        for target in part.get("targets", []):
            for attribute, accessor in target.items():
                if values[accessor].shape != positions.shape:
                    faults.append(f"primitive {number} has a {attribute} target of another size")
                if attribute == "POSITION" and "min" not in document["accessors"][accessor]:
                    faults.append(f"primitive {number} has a target without min and max")
    return faults


def _animation_faults(
    document: dict[str, Any], values: list[np.ndarray], targets: int
) -> list[str]:
    faults = []
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times, output = values[sampler["input"]], values[sampler["output"]]
            if (np.diff(times[:, 0]) <= 0).any():
                faults.append("the animation's times do not increase")
            is_weights = channel["target"]["path"] == "weights"
            if len(output) != len(times) * (targets if is_weights else 1):
                faults.append("the animation does not set every value at every time")
    return faults
