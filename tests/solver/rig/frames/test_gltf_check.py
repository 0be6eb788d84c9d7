"""The structural checks of a GLB see what a loader would fall over."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from solver.rig.frames.read_back import validate_glb

TRIANGLE = 36  # bytes of three positions
FACE = struct.pack("<III", 0, 1, 2)


def document() -> dict[str, Any]:
    """A triangle with one morph target, `smile`."""
    view = {"buffer": 0, "byteLength": TRIANGLE}
    still = {"componentType": 5126, "type": "VEC3", "count": 3, "min": [0] * 3, "max": [0] * 3}
    face = {"componentType": 5125, "type": "SCALAR", "count": 3, "bufferView": 2}
    part = {"attributes": {"POSITION": 0}, "indices": 2, "targets": [{"POSITION": 1}]}
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 2 * TRIANGLE + len(FACE)}],
        "bufferViews": [
            view,
            view | {"byteOffset": TRIANGLE},
            {"buffer": 0, "byteOffset": 2 * TRIANGLE, "byteLength": len(FACE)},
        ],
        "accessors": [still | {"bufferView": 0}, still | {"bufferView": 1}, face],
        "meshes": [{"primitives": [part], "extras": {"targetNames": ["smile"]}}],
    }


def write(path: Path, content: dict[str, Any]) -> Path:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary = bytes(2 * TRIANGLE) + FACE
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


def test_a_sound_file_has_no_faults(tmp_path: Path) -> None:
    assert validate_glb(write(tmp_path / "rig.glb", document()), ["smile"]) == []


def test_a_cut_file_is_noticed(tmp_path: Path) -> None:
    path = write(tmp_path / "rig.glb", document())
    path.write_bytes(path.read_bytes()[:-1])
    assert "length" in validate_glb(path, ["smile"])[0]


@pytest.mark.parametrize(
    ("part", "key", "value", "fault"),
    [
        (["bufferViews", 1], "byteLength", 37, "does not fit"),
        (["accessors", 1], "count", 4, "does not fit"),
        (["accessors", 0], "max", [1, 0, 0], "accessor 0 states another max"),
        (["meshes", 0, "extras"], "targetNames", ["frown"], "not named"),
        (["meshes", 0, "primitives", 0], "targets", [{"POSITION": 1}] * 2, "1 morph targets"),
    ],
)
def test_faults_are_named(
    part: list[Any], key: str, value: Any, fault: str, tmp_path: Path
) -> None:
    broken = document()
    place: Any = broken
    for step in part:
        place = place[step]
    place[key] = value
    faults = validate_glb(write(tmp_path / "rig.glb", broken), ["smile"])
    assert any(fault in each for each in faults), faults
