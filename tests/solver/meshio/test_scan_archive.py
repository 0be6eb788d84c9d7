"""ZIPs of scans: unpacked with what lies beside the mesh, and refused where they are traps."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from zipfile import ZIP_BZIP2, ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import pytest

from solver.errors import InputError
from solver.meshio.colours import read_colours
from solver.meshio.raw import read_raw
from solver.meshio.scan_archive import LIMITS, opened_scan
from tests.solver.meshio.test_colours import MIDDLE, obj


def pack(path: Path, members: dict[str, bytes], packing: int = ZIP_DEFLATED) -> Path:
    with ZipFile(path, "w", packing) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_a_zip_of_a_scan_is_read_with_its_colours_and_leaves_nothing(tmp_path: Path) -> None:
    scan = obj(tmp_path)
    beside = {name: (tmp_path / name).read_bytes() for name in ("face.mtl", "a b.png")}
    members = {f"session 1/{name}": content for name, content in beside.items()}
    members |= {"session 1/face.obj": scan.read_bytes(), "session 1/sub/a b.png": b"another"}
    members |= {"__MACOSX/session 1/._face.obj": b"", "read me.txt": b"hello"}
    with opened_scan(pack(tmp_path / "face.zip", members)) as mesh:
        assert mesh.name == "face.obj"
        assert sorted(each.name for each in mesh.parent.iterdir()) == [
            "a b.png",
            "face.mtl",
            "face.obj",
        ]
        found = read_colours(mesh, read_raw(mesh))
    assert not mesh.parent.exists()
    assert found is not None
    colour, known = found.at(np.zeros(1, np.int64), MIDDLE)
    assert known.all()
    np.testing.assert_allclose(colour[0], [1, 0, 0])


def test_members_may_begin_with_the_folder_they_are_in(tmp_path: Path) -> None:
    scan = obj(tmp_path)
    with opened_scan(pack(tmp_path / "face.zip", {"./face.obj": scan.read_bytes()})) as mesh:
        assert mesh.name == "face.obj"


def test_what_is_no_zip_is_given_as_it_is(tmp_path: Path) -> None:
    with opened_scan(tmp_path / "face.ply") as mesh:
        assert mesh == tmp_path / "face.ply"


BOX = b"v 0 0 0\n"


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"a.png": b""}, "it holds none"),
        ({"a.obj": BOX, "b/b.ply": BOX}, r"it holds 2 \(a.obj, b/b.ply\)"),
        ({"a.obj": BOX, **{f"{n}.png": b"" for n in range(200)}}, "201 files"),
        ({"a.obj": BOX, "a\x1b[31m.png": b""}, "by a name that is none"),
    ],
)
def test_an_archive_that_is_no_scan_is_refused(
    tmp_path: Path, members: dict[str, bytes], words: str
) -> None:
    path = pack(tmp_path / "scan.zip", members)
    with pytest.raises(InputError, match=words) as caught, opened_scan(path):
        pass
    assert caught.value.code == "scan.archive"
    assert caught.value.as_dict()["file"] == "scan.zip"


def test_archives_that_are_traps_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()

    def refused(path: Path, words: str) -> None:
        with pytest.raises(InputError, match=words) as caught, opened_scan(path):
            pass
        assert caught.value.code == "scan.archive"

    refused(pack(folder / "climbing.zip", {"../../escaped.obj": BOX}), "it holds none")
    rooted = pack(folder / "rooted.zip", {f"{tmp_path}/escaped.obj": BOX}, ZIP_STORED)
    with opened_scan(rooted) as mesh:
        assert mesh.read_bytes() == BOX
    assert not list(tmp_path.rglob("escaped.obj"))
    refused(pack(folder / "bzip2.zip", {"a.obj": BOX}, ZIP_BZIP2), "packed in a way")
    whole = pack(folder / "whole.zip", {"a.obj": BOX * 100}).read_bytes()
    (folder / "cut.zip").write_bytes(whole[:-30])
    refused(folder / "cut.zip", "cannot be unpacked")
    torn = bytearray(whole)
    torn[40] ^= 0xFF
    (folder / "torn.zip").write_bytes(torn)
    refused(folder / "torn.zip", "cannot be unpacked")
    # a directory that claims less than the member unpacks to
    place = whole.index(b"PK\1\2")
    lying = whole[: place + 24] + struct.pack("<L", 8) + whole[place + 28 :]
    (folder / "lying.zip").write_bytes(lying)
    refused(folder / "lying.zip", "cannot be unpacked")
    small = replace(LIMITS, most_bytes=700)
    words = "of 800 bytes; at most"
    with pytest.raises(InputError, match=words), opened_scan(folder / "whole.zip", small):
        pass
