"""The structural checks of a GLB see what a loader would fall over."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from myoface.demo.gltf import structural_faults

TRIANGLE = 36  # bytes of three positions


def document() -> dict[str, Any]:
    """A triangle with one morph target, `smile`."""
    view = {"buffer": 0, "byteLength": TRIANGLE}
    accessor = {"componentType": 5126, "type": "VEC3", "count": 3}
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 2 * TRIANGLE}],
        "bufferViews": [view, view | {"byteOffset": TRIANGLE}],
        "accessors": [accessor | {"bufferView": 0}, accessor | {"bufferView": 1}],
        "meshes": [
            {
                "primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}]}],
                "extras": {"targetNames": ["smile"]},
            }
        ],
    }


def write(path: Path, content: dict[str, Any]) -> Path:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", 2 * TRIANGLE, 0x004E4942) + bytes(2 * TRIANGLE)
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


def test_a_sound_file_has_no_faults(tmp_path: Path) -> None:
    assert structural_faults(write(tmp_path / "rig.glb", document()), ["smile"]) == []


def test_a_cut_file_is_no_glb(tmp_path: Path) -> None:
    path = write(tmp_path / "rig.glb", document())
    path.write_bytes(path.read_bytes()[:-1])
    assert "not a GLB" in structural_faults(path, ["smile"])[0]


@pytest.mark.parametrize(
    ("part", "key", "value", "fault"),
    [
        (["bufferViews", 1], "byteLength", 37, "buffer view 1"),
        (["accessors", 1], "count", 4, "accessor 1 reaches out"),
        (["meshes", 0, "extras"], "targetNames", ["frown"], "frown"),
        (["meshes", 0, "primitives", 0], "targets", [{"POSITION": 1}] * 2, "2 morph targets"),
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
    faults = structural_faults(write(tmp_path / "rig.glb", broken), ["smile"])
    assert any(fault in each for each in faults), faults
