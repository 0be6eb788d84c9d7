"""The container that browsers read: what goes in comes out, at the places the header says."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.storage import read_container, write_container


def _arrays(count: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    arrays: dict[str, np.ndarray] = {
        "neutral": rng.normal(size=(5, 3)).astype(np.float32),
        "main_muscle": np.array([0, 255, 3], np.uint8),
        "faces": np.array([[0, 1, 2], [2, 3, 4]], np.uint32),
        "nothing": np.zeros((0, 3), np.float32),
    }
    for number in range(count):
        arrays[f"skin/{number}"] = rng.normal(size=(5, 3)).astype(np.float16)
    return arrays


@pytest.mark.parametrize("count", [0, 3, 200])
def test_arrays_and_header_come_back(tmp_path: Path, count: int) -> None:
    path = tmp_path / "view.bin"
    arrays = _arrays(count)
    write_container(path, {"muscles": ["Zygomaticus major", "Lèvre"]}, arrays)
    read = read_container(str(path))
    assert read.header == {"unit": "mm", "muscles": ["Zygomaticus major", "Lèvre"]}
    assert list(read.arrays) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read.arrays[name], array)
        assert read.arrays[name].dtype == array.dtype


def test_layout_is_what_a_browser_can_map(tmp_path: Path) -> None:
    path = tmp_path / "view.bin"
    write_container(path, {"muscles": []}, _arrays())
    content = path.read_bytes()
    magic, length = struct.unpack_from("<4sI", content)
    header = json.loads(content[8 : 8 + length])
    assert (magic, header["format"], header["unit"]) == (b"MYOV", 1, "mm")
    assert (8 + length) % 8 == 0
    assert all(entry["offset"] % 8 == 0 for entry in header["arrays"].values())
    place = header["arrays"]["faces"]["offset"]
    assert struct.unpack_from("<6I", content, place) == (0, 1, 2, 2, 3, 4)


def test_same_content_gives_the_same_bytes_in_any_memory_order(tmp_path: Path) -> None:
    one = tmp_path / "one.bin"
    two = tmp_path / "two.bin"
    arrays = _arrays()
    write_container(one, {}, arrays)
    other = {name: np.asfortranarray(array) for name, array in arrays.items()}
    other["neutral"] = other["neutral"].astype(">f4")
    write_container(two, {}, other)
    assert one.read_bytes() == two.read_bytes()


def test_other_dtypes_and_nan_in_the_header_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="float64"):
        write_container(tmp_path / "a.bin", {}, {"x": np.zeros(3)})
    with pytest.raises(ValueError, match="JSON"):
        write_container(tmp_path / "a.bin", {"mean": float("nan")}, {})


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        (b"MYOV", b"GLTF", "view.unreadable"),
        (b'"format":1', b'"format":2', "view.format"),
        (b'"shape":[5,3]', b'"shape":[9999]', "view.unreadable"),
        (b'"shape":[5,3]', b'"shape":[-1]', "view.unreadable"),
        (b'"shape":[5,3]', b'"shape":[1e9]', "view.unreadable"),
        (b'"dtype":"uint32"', b'"dtype":"object"', "view.unreadable"),
        (b'"arrays"', b'"arrows"', "view.unreadable"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path: Path, old: bytes, new: bytes, code: str) -> None:
    path = tmp_path / "view.bin"
    write_container(path, {}, _arrays())
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new.ljust(len(old)), 1))
    with pytest.raises(InputError) as caught:
        read_container(path)
    assert caught.value.code == code
    assert caught.value.context["file"] == "view.bin"


@pytest.mark.parametrize("length", [0, 5, 60])
def test_truncated_files_are_refused(tmp_path: Path, length: int) -> None:
    path = tmp_path / "view.bin"
    write_container(path, {}, _arrays())
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(InputError, match=r"view\.bin"):
        read_container(path)
