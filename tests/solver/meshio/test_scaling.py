"""Readers take time in proportion to a file's size, whatever is in it."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.meshio.raw import read_raw
from solver.meshio.registered import REGISTERED_FORMATS, read_registered
from solver.registration.landmarks import read_landmarks
from solver.scans.live_link import ARKIT_NAMES, read_live_link
from solver.scans.performance import open_performance
from solver.surface import Surface

LEAST_SECONDS = 0.02  # a shorter time says nothing
MOST_GROWTH = 8.0  # of the time, from n to 4 n: caches cost a little, a square is 16
MOST = 100_000  # n with which a reader may still be too fast to be measured
TRIANGLE = np.array([[0, 1, 2]])
CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
NORMALS = b"vn 0 0 1\n" * 3
VERTEX = b"property float x\nproperty float y\nproperty float z\n"
LISTS = b"property list uchar int vertex_indices\nend_header\n"

pytestmark = pytest.mark.long


def ply(form: str, vertices: int, faces: int) -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n".encode() + VERTEX
    return head + f"element face {faces}\n".encode() + LISTS


def glb(binary: bytes, **document: object) -> bytes:
    text = json.dumps({"buffers": [{}], "bufferViews": [{"buffer": 0}], **document}).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text
    chunks += len(binary).to_bytes(4, "little") + b"BIN\0" + binary
    size = 12 + len(chunks)
    return b"glTF" + (2).to_bytes(4, "little") + size.to_bytes(4, "little") + chunks


def shared_glb(meshes: int, parts: int, vertices: int, name: str = "a") -> bytes:
    """Return nodes that show one mesh, whose parts use the same positions."""
    accessor = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": vertices}
    part = {"attributes": {"POSITION": 0}, "mode": 0}
    return glb(
        bytes(12 * vertices),
        scenes=[{"nodes": list(range(meshes))}],
        nodes=[{"mesh": 0}] * meshes,
        meshes=[{"name": name, "primitives": [part] * parts}],
        accessors=[accessor],
    )


def take(weights: int, header: str = "") -> bytes:
    rows = "".join(f"0:0:{k // 60 % 60}:{k % 60}" + ",0" * 52 + "\n" for k in range(weights))
    return ("timecode," + ",".join(ARKIT_NAMES) + header + "\n" + rows).encode()


def points(number: int) -> dict[str, list[int]]:
    return {f"name{k}": [0, 0, k] for k in range(number)}


HOSTILE: dict[str, Callable[[int], bytes]] = {
    "digits.obj": lambda n: CORNERS + NORMALS + b"f " + b"0" * n + b"1 2 3\n",
    "slashes.obj": lambda n: CORNERS + NORMALS + b"f 1" + b"/1" * n + b" 2 3\n",
    "corners.obj": lambda n: CORNERS + NORMALS + b"f" + b" 1/1/1" * n + b"\n",
    "fraction.obj": lambda n: b"v 0." + b"1" * n + b" 0 0\n" + CORNERS,
    "columns.obj": lambda n: b"v" + b" 1" * n + b"\n",
    "blanks.obj": lambda n: b"v " + b" " * n + b"\n" * n + CORNERS,
    "groups.obj": lambda n: (
        CORNERS + b"g" + b"".join(b" %d" % k for k in range(n)) + b"\no a\nf 1 2 3" * n + b"\n"
    ),
    "continued.obj": lambda n: CORNERS + b"a\\\n" * n + b"\nv 0 0\n",
    "faults.obj": lambda n: CORNERS * n + b"f -1 -2 -3\n" * n + b"f 1 2 0\n",
    "text.ply": lambda n: ply("ascii", n, n) + b"0 0 0\n\n" * n + b"3 0 1 2\n" * (n - 1) + b"9 1\n",
    "row.ply": lambda n: ply("ascii", 1, 1) + b"0 0 0\n%d" % n + b" 0" * n + b"\n",
    "lists.ply": lambda n: (
        ply("binary_little_endian", 1, 2 * n) + bytes(12) + (b"\0" + b"\1" + bytes(4)) * n
    ),
    "header.ply": lambda n: b"ply\nformat ascii 1.0\ncomment" + b" a" * n + b"\nelement v 1\n",
    "property.ply": lambda n: (
        b"ply\nformat ascii 1.0\nelement v 1\nproperty int " + b"a" * n + b"\n"
    ),
    "blanks.stl": lambda n: b"solid" + b" " * n + b"\n" * n,
    "vertices.stl": lambda n: b"solid a\n" + b"vertex 0 0 0\n" * n + b"vertex 0 0\nendsolid\n",
    "facets.stl": lambda n: bytes(80) + n.to_bytes(4, "little") + bytes(50 * n),
    "shared.glb": lambda n: shared_glb(n, 1, n),
    "parts.glb": lambda n: shared_glb(n, n, 1),
    "names.glb": lambda n: shared_glb(1, n, 1, "a" * 10 * n),
    "chunks.glb": lambda n: glb(b"") + bytes(8 * n),
    "points.xyz": lambda n: b"1 2 3\n" * n + b"1 2\n",
    "comments.xyz": lambda n: b"#\n" * n + b"a\nb\n" + b"1 2 3\n" * n,
    "count.xyz": lambda n: b"1" * n + b"\n0 0 0\n",
    "row.xyz": lambda n: b"1 " * n + b"\n",
    "words.xyz": lambda n: b"1 2 " + b"a" * n + b" \t" * n + b"!\n",
    "names.json": lambda n: json.dumps(points(n)).encode(),
    "labels.ljson": lambda n: json.dumps(
        {
            "groups": {
                "a": {
                    "labels": [{"label": "jaw", "mask": [0] * 17}] * n,
                    "landmarks": {"points": [[0, 0, 0]] * n},
                }
            }
        }
    ).encode(),
    "deep.json": lambda n: b"[" * n,
    "names.csv": lambda n: b"".join(b"name%d,0,0,0\n" % k for k in range(n)) + b"a,b,c,d\n",
    "take.csv": take,
    "columns.csv": lambda n: take(3, "".join(f",a{k}" for k in range(n))),
    "quotes.csv": lambda n: take(3) + b'"' * n,
    "array.npy": lambda n: npy(n),
}


def npy(frames: int) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({frames}, 3, 3)}}\n".encode()
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + bytes(36 * frames)


def play(path: Path) -> None:
    performance = open_performance(path, Surface(np.eye(3), TRIANGLE), np.arange(3))
    for number in range(len(performance)):
        performance.frame(number)


def readers(path: Path) -> list[Callable[[Path], object]]:
    if path.suffix == ".npy":
        return [play]
    if path.suffix in (".json", ".ljson"):
        return [read_landmarks]
    if path.suffix == ".csv":
        return [read_raw, read_landmarks, read_live_link]
    strict = [lambda path: read_registered(path, TRIANGLE, 3)]
    return [read_raw, *(strict if path.suffix in REGISTERED_FORMATS else [])]


def seconds(read: Callable[[Path], object], path: Path, times: int) -> float:
    """Return the least processor time of reading a file, whatever is wrong with it."""
    taken = []
    gc.disable()
    for _ in range(times):
        start = time.process_time()
        with suppress(InputError):
            read(path)
        taken.append(time.process_time() - start)
    gc.enable()
    return min(taken)


@pytest.mark.parametrize("name", HOSTILE)
def test_time_grows_with_the_size_of_a_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    for read in readers(path):

        def timed(size: int, times: int, read: Callable[[Path], object] = read) -> float:
            path.write_bytes(HOSTILE[name](size))
            return seconds(read, path, times)

        size = 1000
        while size < MOST and timed(size, 1) < LEAST_SECONDS:
            size *= 2
        if size < MOST:
            short, long = timed(size, 3), timed(4 * size, 1)
            if long > MOST_GROWTH * short:
                middle, long = timed(2 * size, 3), timed(4 * size, 3)
                assert long <= MOST_GROWTH * short, (size, short, middle, long)
