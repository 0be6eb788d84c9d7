"""Reading of GLB files, and structural checks for places without the Khronos validator."""

from __future__ import annotations

import json
from collections.abc import Iterator
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
    try:
        document, binary = split_glb(path)
    except ValueError as error:
        return [str(error)]
    try:
        return list(_faults(document, binary, names))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return [f"the description does not fit the data: {error!r}"]


def split_glb(path: Path) -> tuple[dict[str, Any], memoryview]:
    """Return the description and the binary of a file; raises :class:`ValueError` if it is none."""
    content = path.read_bytes()
    if content[:4] != b"glTF" or len(content) < 20:
        raise ValueError("not a binary glTF file")
    if int.from_bytes(content[8:12], "little") != len(content):
        raise ValueError("the header's length is not the file's")
    end = 20 + int.from_bytes(content[12:16], "little")
    return json.loads(content[20:end]), memoryview(content)[end + 8 :]


def _faults(document: dict[str, Any], binary: memoryview, names: list[str]) -> Iterator[str]:
    values = [accessor_values(document, binary, accessor) for accessor in document["accessors"]]
    for number, (accessor, table) in enumerate(zip(document["accessors"], values, strict=True)):
        if not np.isfinite(table).all():
            yield f"accessor {number} holds what is not finite"
        for name, bound in (("min", table.min(axis=0)), ("max", table.max(axis=0))):
            if name in accessor and not np.array_equal(bound, np.float32(accessor[name])):
                yield f"accessor {number} states another {name} than it has"
    mesh = document["meshes"][0]
    if mesh.get("extras", {}).get("targetNames", []) != names:
        yield "the morph targets are not named as the expressions"
    for number, part in enumerate(mesh["primitives"]):
        positions, targets = values[part["attributes"]["POSITION"]], part.get("targets", [])
        if values[part["indices"]].max() >= len(positions):
            yield f"primitive {number} uses a vertex that is not there"
        if len(targets) != len(names):
            yield f"primitive {number} does not have {len(names)} morph targets"
        for attribute, accessor in (each for target in targets for each in target.items()):
            if values[accessor].shape != positions.shape:
                yield f"primitive {number} has a {attribute} target of another size"
            if attribute == "POSITION" and "min" not in document["accessors"][accessor]:
                yield f"primitive {number} has a target without min and max"
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times, output = values[sampler["input"]], values[sampler["output"]]
            if (np.diff(times[:, 0]) <= 0).any():
                yield "the animation's times do not increase"
            each = len(names) if channel["target"]["path"] == "weights" else 1
            if len(output) != len(times) * each:
                yield "the animation does not set every value at every time"


def accessor_values(
    document: dict[str, Any], binary: memoryview, accessor: dict[str, Any]
) -> np.ndarray:
    """Return an accessor's table as it is stored, its sparse values put in."""

    def read(view: int, kind: str, *shape: int) -> np.ndarray:
        place = document["bufferViews"][view]
        start, size = place.get("byteOffset", 0), place["byteLength"]
        if start % np.dtype(kind).itemsize:
            raise ValueError(f"bufferView {view} is not aligned")
        return np.frombuffer(binary[start : start + size], kind).reshape(shape)

    width, kind = WIDTHS[accessor["type"]], COMPONENTS[accessor["componentType"]]
    values = np.zeros((accessor["count"], width), kind)
    if "bufferView" in accessor:
        values = read(accessor["bufferView"], kind, *values.shape)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        place, count = sparse["indices"], sparse["count"]
        rows = read(place["bufferView"], COMPONENTS[place["componentType"]], count)
        if (np.diff(rows.astype(np.int64)) <= 0).any():
            raise ValueError("sparse indices do not increase")
        values[rows] = read(sparse["values"]["bufferView"], kind, count, width)
    return values
