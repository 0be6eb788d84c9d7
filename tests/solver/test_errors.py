"""Quotes of files in messages: short, on one line, printable."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError, quote, quote_names
from solver.meshio.raw import read_raw
from solver.registration.landmarks import match, read_landmarks
from solver.storage import Archive
from solver.templates.builtin.build import builtin_template


def test_a_quote_is_short_and_printable() -> None:
    assert quote("brow") == "brow"
    assert quote("a\nb\x1b[31m\u202e") == "a\\nb\\x1b[31m\\u202e"
    assert len(quote("\0" * 10**6)) <= 60
    assert quote(10**70).endswith("...")


def test_a_list_of_names_ends_with_how_many_follow() -> None:
    assert quote_names(["a", "b"]) == ["a", "b"]
    names = quote_names([f"{number}" for number in range(1000)])
    assert names[-1] == "and 980 more"
    assert len(names) == 21


LONG = "x\n" * 10**5


def glb(document: object) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little") + chunk


def shown(accessor: dict[str, object]) -> bytes:
    mesh = {"name": LONG, "primitives": [{"attributes": {"POSITION": 0}, "indices": 0}]}
    return glb(
        {
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [mesh],
            "accessors": [accessor],
            "bufferViews": [{"buffer": 0}],
            "buffers": [{}],
        }
    )


HOSTILE = {
    "name.obj": f"v 0 {LONG} 0\n".replace("\n", " ").encode(),
    "element.ply": f"ply\nelement {LONG}\n".replace("x\n", "x ").encode(),
    "property.ply": b"ply\nformat ascii 1.0\nelement v 1\n"
    + 2 * (b"property int " + b"x" * 10**5 + b"\n"),
    "type.glb": shown({"bufferView": 0, "componentType": LONG, "type": "VEC3", "count": 1}),
    "count.glb": shown({"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 10**400}),
    "root.glb": glb({"scenes": [{"nodes": [LONG]}]}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_errors_of_meshes_quote_little(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(HOSTILE[name])
    assert_short(lambda: read_raw(tmp_path / name))


def test_errors_of_archives_and_landmarks_quote_little(tmp_path: Path) -> None:
    header = np.frombuffer(json.dumps({"format": LONG}).encode(), np.uint8)
    np.savez(tmp_path / "a.npz", header=header)
    assert_short(lambda: Archive.read(tmp_path / "a.npz", "model", "a model", 1))
    (tmp_path / "a.json").write_text(json.dumps({LONG: [1, 2]}))
    assert_short(lambda: read_landmarks(tmp_path / "a.json"))
    points = {f"{LONG}{number}": np.zeros(3) for number in range(100)}
    assert_short(lambda: match("a.json", points, builtin_template()))


def assert_short(call) -> None:
    with pytest.raises(InputError) as caught:
        call()
    said = json.dumps(caught.value.as_dict())
    assert len(said) < 6000
    assert "\n" not in caught.value.message
