"""Checks of a GLB file: what a loader needs is there, in bounds and named."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

MAGIC, VERSION, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
VALIDATOR_FILES = ("package.json", "package-lock.json", "validate.mjs")
VALIDATOR_TIMEOUT_S = 180


def structural_faults(path: Path, expressions: list[str]) -> list[str]:
    """Return what is wrong with a GLB, in words.

    Its mesh must have one morph target per expression, named so, and each accessor must lie in
    its buffer view and each buffer view in the binary chunk.
    """
    try:
        document, binary_bytes = _chunks(path.read_bytes())
    except (ValueError, struct.error) as error:
        return [f"not a GLB: {error}"]
    faults = []
    for number, view in enumerate(document.get("bufferViews", [])):
        if view.get("byteOffset", 0) + view["byteLength"] > binary_bytes:
            faults.append(f"buffer view {number} is longer than the file")
    for number, accessor in enumerate(document.get("accessors", [])):
        if "bufferView" in accessor and _end(accessor) > _room(document, accessor):
            faults.append(f"accessor {number} reaches out of its buffer view")
    return faults + _morph_faults(document, expressions)


def _morph_faults(document: dict[str, Any], expressions: list[str]) -> list[str]:
    morphed = [mesh for mesh in document["meshes"] if "targets" in mesh["primitives"][0]]
    if len(morphed) != 1:
        return [f"{len(morphed)} meshes have morph targets, not one"]
    faults = []
    names = morphed[0].get("extras", {}).get("targetNames", [])
    if sorted(names) != sorted(expressions):
        faults.append(f"morph targets are named {names}, the expressions are {expressions}")
    for primitive in morphed[0]["primitives"]:
        if len(primitive["targets"]) != len(expressions):
            faults.append(f"{len(primitive['targets'])} morph targets, not {len(expressions)}")
        count = document["accessors"][primitive["attributes"]["POSITION"]]["count"]
        for target in primitive["targets"]:
            if document["accessors"][target["POSITION"]]["count"] != count:
                faults.append("a morph target has another number of vertices than the mesh")
    return faults


def _chunks(data: bytes) -> tuple[dict[str, Any], int]:
    magic, version, length = struct.unpack_from("<III", data)
    if (magic, version) != (MAGIC, VERSION) or length != len(data):
        raise ValueError("its header is wrong or its length is not the file's")
    json_bytes, kind = struct.unpack_from("<II", data, 12)
    if kind != JSON_CHUNK:
        raise ValueError("its first chunk is not JSON")
    document = json.loads(data[20 : 20 + json_bytes])
    binary_bytes, kind = struct.unpack_from("<II", data, 20 + json_bytes)
    if kind != BIN_CHUNK:
        raise ValueError("its second chunk is not binary")
    return document, binary_bytes


def _end(accessor: dict[str, Any]) -> int:
    size = COMPONENT_BYTES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
    return int(accessor.get("byteOffset", 0) + accessor["count"] * size)


def _room(document: dict[str, Any], accessor: dict[str, Any]) -> int:
    return int(document["bufferViews"][accessor["bufferView"]]["byteLength"])


@dataclass(frozen=True)
class Validation:
    """The Khronos validator's word; ``errors`` is None where it could not run, see ``note``."""

    errors: int | None
    warnings: int | None
    note: str


def khronos_validation(path: Path, cache: Path) -> Validation:
    """Run the Khronos glTF validator (npm package ``gltf-validator``, kept in ``cache``)."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        return Validation(None, None, "not run: it needs node and npm (apt-get install nodejs npm)")
    try:
        _install(npm, cache)
        command = [node, "validate.mjs", str(path.resolve())]
        done = subprocess.run(
            command, cwd=cache, capture_output=True, check=True, timeout=VALIDATOR_TIMEOUT_S
        )
    except (subprocess.SubprocessError, OSError) as error:
        return Validation(None, None, f"not run: {error}")
    issues = json.loads(done.stdout)
    first = issues["messages"][0]["message"] if issues["messages"] else ""
    return Validation(issues["numErrors"], issues["numWarnings"], first)


def _install(npm: str, cache: Path) -> None:
    if (cache / "node_modules" / "gltf-validator" / "package.json").exists():
        return
    cache.mkdir(parents=True, exist_ok=True)
    for name in VALIDATOR_FILES:
        text = resources.files("myoface.demo").joinpath("khronos", name).read_text()
        (cache / name).write_text(text)
    command = [npm, "ci", "--silent", "--no-audit", "--no-fund"]
    subprocess.run(command, cwd=cache, capture_output=True, check=True, timeout=VALIDATOR_TIMEOUT_S)
