"""Hostile inputs of any size: each is as large as n says, and made to cost its reader the most."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import PurePath
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from PIL import Image

from solver.scans.live_link import ARKIT_NAMES
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY
from tests import take_files
from tests.campaigns.fuzz import seeds

Make = Callable[[int], bytes]

CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
NORMALS = b"vn 0 0 1\n" * 3
VERTEX = b"property float x\nproperty float y\nproperty float z\n"
LISTS = b"property list uchar int vertex_indices\nend_header\n"


def _ply(form: str, vertices: int, faces: int) -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n".encode() + VERTEX
    return head + f"element face {faces}\n".encode() + LISTS


def _glb(binary: bytes, **document: object) -> bytes:
    text = json.dumps({"buffers": [{}], "bufferViews": [{"buffer": 0}], **document}).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text
    chunks += len(binary).to_bytes(4, "little") + b"BIN\0" + binary
    size = 12 + len(chunks)
    return b"glTF" + (2).to_bytes(4, "little") + size.to_bytes(4, "little") + chunks


def _shared_glb(meshes: int, parts: int, vertices: int, name: str = "a") -> bytes:
    """Return nodes that show one mesh, whose parts use the same positions."""
    accessor = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": vertices}
    part = {"attributes": {"POSITION": 0}, "mode": 0}
    return _glb(
        bytes(12 * vertices),
        scenes=[{"nodes": list(range(meshes))}],
        nodes=[{"mesh": 0}] * meshes,
        meshes=[{"name": name, "primitives": [part] * parts}],
        accessors=[accessor],
    )


def _take(weights: int, header: str = "") -> bytes:
    rows = "".join(f"0:0:{k // 60 % 60}:{k % 60}" + ",0" * 52 + "\n" for k in range(weights))
    return ("timecode," + ",".join(ARKIT_NAMES) + header + "\n" + rows).encode()


def _picture(form: str, size: int, **more: Any) -> bytes:
    """Return a black picture of eight pixels for each of ``size``."""
    stream = io.BytesIO()
    Image.new("RGB", (2048, min(max(64, size // 256), 65_000))).save(stream, form, **more)
    return stream.getvalue()


def _chunks(number: int) -> bytes:
    """Return a PNG with chunks that nobody knows."""
    content = _picture("PNG", 64)
    empty = struct.pack(">I4sI", 0, b"abCd", zlib.crc32(b"abCd"))
    return content[:33] + empty * number + content[33:]


def _zigzag(number: int) -> list[list[float]]:
    """Return a curve that crosses itself at every step."""
    return [[10.0 + 70.0 * (k * 0.618 % 1), 10.0 + 50.0 * (k * 0.325 % 1)] for k in range(number)]


def _points(number: int) -> dict[str, list[int]]:
    return {f"name{k}": [0, 0, k] for k in range(number)}


def _npy(frames: int) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({frames}, 3, 3)}}\n".encode()
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + bytes(36 * frames)


def _packed(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with ZipFile(stream, "w", ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def _arrays(**named: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **named)
    return stream.getvalue()


def _tracks(count: int) -> np.ndarray:
    return np.arange(6.0 * count).reshape(2, -1, 3)


def _records(count: int) -> bytes:
    """Return a C3D with many parameters, which go on to where the data begin."""
    head = take_files.c3d_bytes(_tracks(2))[: take_files.BLOCK]
    section = bytes([1, 0x50, 1, take_files.INTEL]) + b"\1\1A\7\0\2\0\0\0\0" * count
    blocks = -(-len(section) // take_files.BLOCK)
    head = head[:16] + min(2 + blocks, 65535).to_bytes(2, "little") + head[18:]
    return head + section.ljust(blocks * take_files.BLOCK, b"\0")


def _cloud(frames: int, count: int, seen: int | None = None) -> np.ndarray:
    """Return points (f, k, 3) that lie on no face and jump; some labels are never ``seen``."""
    size = (frames, count, 3)
    points = np.random.default_rng(count).normal((10.0, 800.0, 30.0), (45.0, 55.0, 25.0), size)
    points[:, seen if seen is not None else count :] = np.nan
    return points


def _alike(count: int) -> list[str]:
    """Return labels of which many would be called the same."""
    return ["a", *(f"a_{number}" for number in range(2, count // 2 + 2)), *["a"] * count][:count]


def _set(count: int) -> bytes:
    markers = tuple(Marker(f"a{number}") for number in range(count))
    return json.dumps(MarkerSet(markers, IDENTITY, "0" * 64).to_document()).encode()


def _scene(members: int) -> bytes:
    keys = [{"time": number, "muscles": {"a": 1.5, "b": [1, 0, 0]}} for number in range(members)]
    return json.dumps({"kind": "simulate", "options": {"keys": keys}}).encode()


# File name -> a file of that kind, hostile and as large as n says
FILES: dict[str, Callable[[int], bytes]] = {
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
    "text.ply": lambda n: (
        _ply("ascii", n, n) + b"0 0 0\n\n" * n + b"3 0 1 2\n" * (n - 1) + b"9 1\n"
    ),
    "row.ply": lambda n: _ply("ascii", 1, 1) + b"0 0 0\n%d" % n + b" 0" * n + b"\n",
    "lists.ply": lambda n: (
        _ply("binary_little_endian", 1, 2 * n) + bytes(12) + (b"\0" + b"\1" + bytes(4)) * n
    ),
    "header.ply": lambda n: b"ply\nformat ascii 1.0\ncomment" + b" a" * n + b"\nelement v 1\n",
    "property.ply": lambda n: (
        b"ply\nformat ascii 1.0\nelement v 1\nproperty int " + b"a" * n + b"\n"
    ),
    "blanks.stl": lambda n: b"solid" + b" " * n + b"\n" * n,
    "vertices.stl": lambda n: b"solid a\n" + b"vertex 0 0 0\n" * n + b"vertex 0 0\nendsolid\n",
    "facets.stl": lambda n: bytes(80) + n.to_bytes(4, "little") + bytes(50 * n),
    "shared.glb": lambda n: _shared_glb(n, 1, n),
    "parts.glb": lambda n: _shared_glb(n, n, 1),
    "names.glb": lambda n: _shared_glb(1, n, 1, "a" * 10 * n),
    "chunks.glb": lambda n: _glb(b"") + bytes(8 * n),
    "points.xyz": lambda n: b"1 2 3\n" * n + b"1 2\n",
    "comments.xyz": lambda n: b"#\n" * n + b"a\nb\n" + b"1 2 3\n" * n,
    "count.xyz": lambda n: b"1" * n + b"\n0 0 0\n",
    "row.xyz": lambda n: b"1 " * n + b"\n",
    "words.xyz": lambda n: b"1 2 " + b"a" * n + b" \t" * n + b"!\n",
    "names.json": lambda n: json.dumps(_points(n)).encode(),
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
    "take.csv": _take,
    "columns.csv": lambda n: _take(3, "".join(f",a{k}" for k in range(n))),
    "quotes.csv": lambda n: _take(3) + b'"' * n,
    "array.npy": lambda n: _npy(n),
    "muscles.osim": seeds.neck_of,
    "elements.osim": lambda n: b"<OpenSimDocument>" + b"<a/>" * n + b"</OpenSimDocument>",
    "deep.osim": lambda n: b"<a>" * n,
    "text.osim": lambda n: b"<OpenSimDocument>" + b"1 \n" * n + b"</OpenSimDocument>",
    "attributes.osim": lambda n: b"<a" + b"".join(b' b%d="1"' % k for k in range(n)) + b"/>",
    "entities.osim": lambda n: b"<!DOCTYPE a [" + b'<!ENTITY b "">' * n + b"]><a/>",
}


DESCRIPTION = b'format = 1\nunit = "mm"\nup = "y"\nforward = "z"\n'
# Target -> what else it is given
OTHERS: dict[str, dict[str, Make]] = {
    "npz": {
        "members": lambda n: _arrays(**{f"a{k}": np.zeros(1) for k in range(n)}),
        "header": lambda n: _arrays(
            header=np.frombuffer(json.dumps({"format": 1, "name": "a" * n}).encode(), np.uint8)
        ),
        "array": lambda n: _arrays(x=np.zeros((n, 3))),
        "text": lambda n: _arrays(x=np.array(["a" * n])),
    },
    "markers c3d": {
        "frames": lambda n: take_files.c3d_bytes(take_files.face_points(n, 3)),
        "records": _records,
        "cut": lambda n: take_files.c3d_bytes(take_files.face_points(n, 3))[:-512],
    },
    "markers trc": {
        "frames": lambda n: take_files.trc_bytes(take_files.face_points(n, 3)),
        "labels": lambda n: take_files.trc_bytes(_tracks(n), _alike(n)),
        "blanks": lambda n: take_files.trc_bytes(_tracks(2)) + b" " * n + b"\n" * n,
        "columns": lambda n: take_files.trc_bytes(_tracks(2)) + b"3\t0" + b"\t1" * n,
        "digits": lambda n: take_files.trc_bytes(_tracks(2)) + b"3\t0." + b"1" * n,
        "values": lambda n: take_files.trc_bytes(_tracks(2)).replace(b"\n", b"\ta" * n + b"\n", 2),
    },
    "markers motive": {
        "frames": lambda n: take_files.motive_bytes(take_files.face_points(n, 3)),
        "labels": lambda n: take_files.motive_bytes(_tracks(n), _alike(n)),
        "quotes": lambda n: b"Format Version," + b'"' * n,
        "names": lambda n: b"Format Version" + b",a" * n + b"\n" * n,
    },
    "markers npz": {
        "frames": lambda n: take_files.npz_bytes(take_files.face_points(n, 3)),
        "labels": lambda n: take_files.npz_bytes(_tracks(n), _alike(n)),
    },
    "marker set": {
        "markers": _set,
        "deep": lambda n: b"[" * n,
        "members": lambda n: b"{" + b",".join(b'"%d":1' % k for k in range(n)) + b"}",
    },
    "markers check": {
        "markers": lambda n: take_files.c3d_bytes(_cloud(40, max(4, n // 20)), rate=1.0),
        "frames": lambda n: take_files.c3d_bytes(_cloud(n, 20)),
        "labels": lambda n: take_files.npz_bytes(_cloud(4, 20 + n, seen=20)),
    },
    "picture jpg": {
        "pixels": lambda n: _picture("JPEG", n),
        "passes": lambda n: _picture("JPEG", 64, progressive=True) + b"\xff\xda\0\2" * n,
        "comments": lambda n: b"\xff\xd8" + b"\xff\xfe\0\2" * n + _picture("JPEG", 64)[2:],
        "fill": lambda n: _picture("JPEG", 64)[:-2] + b"\xff" * n + b"\xff\xd9",
        "tail": lambda n: _picture("JPEG", 64) + bytes(n),
    },
    "picture png": {
        "pixels": lambda n: _picture("PNG", n),
        "chunks": lambda n: _chunks(n),
        "tail": lambda n: _picture("PNG", 64) + b"\n" * n,
    },
    "photograph json": {
        "landmarks": lambda n: json.dumps({"landmarks": _points(n)}).encode(),
        "names": lambda n: json.dumps({"landmarks": {"a" * n: [1, 2]}}).encode(),
        "curve": lambda n: json.dumps({"curves": {"lips_outer": _zigzag(n)}}).encode(),
        "deep": lambda n: b"[" * n,
    },
    "known activations": {
        "rows": lambda n: (
            b"muscle,time,value,sd\n"
            + b"".join(b"procerus,%.6f,0.1,0.1\n" % (1e-6 * k) for k in range(n))
        ),
        "blanks": lambda n: b"muscle,value,sd" + b"\n" * n,
        "quotes": lambda n: b"muscle,value,sd\n" + b'"' * n,
        "names": lambda n: b"muscle,value,sd\n" + b"frontalis_l." * n + b",0.1,0.1\n",
        "columns": lambda n: b"muscle,value,sd\n" + b"," * n,
        "digits": lambda n: b"muscle,value,sd\nprocerus,0." + b"1" * n + b",0.1\n",
    },
    "sequence": {
        "frames": lambda n: seeds.sequence_bytes(n, 2),
        "muscles": lambda n: seeds.sequence_bytes(2, n),
    },
    "template": {
        "members": lambda n: _packed({f"{k}.obj": b"" for k in range(n)}),
        "description": lambda n: _packed({"template.toml": DESCRIPTION + b"a = 1\n" * n}),
        "dots": lambda n: _packed({"template.toml": b"a" + b".a" * n + b" = 1\n"}),
        "lists": lambda n: _packed({"template.toml": b"a = " + b"[" * n}),
        "skin": lambda n: _packed(
            {"template.toml": DESCRIPTION, "skin.obj": CORNERS * n + b"f 1 2 3\n" * n}
        ),
    },
    "template file": {
        "skin": lambda n: _arrays(skin_vertices=np.zeros((n, 3))),
        "header": lambda n: _arrays(header=np.frombuffer(b"[" * n, np.uint8)),
    },
    "upload metadata": {
        "pairs": lambda n: b",".join(b"a%d YQ==" % k for k in range(n)),
        "one pair": lambda n: b"filename " + b"YQ" * n,
        "blanks": lambda n: b"filename" + b" " * n + b"YQ==",
        "commas": lambda n: b"," * n,
        "padding": lambda n: b"filename YQ" + b"=" * n,
    },
    "upload checksum": {
        "digest": lambda n: b"sha256 " + b"YQ" * n,
        "blanks": lambda n: b"sha256" + b" " * n,
        "name": lambda n: b"a" * n + b" YQ==",
    },
    "cursor": {
        "words": lambda n: base64.urlsafe_b64encode(b"a " * n),
        "date": lambda n: base64.urlsafe_b64encode(b"2026-11-21T19:00:00." + b"1" * n + b" a"),
        "id": lambda n: base64.urlsafe_b64encode(b"2026-11-21T19:00:00 " + b"a" * n),
        "no base64": lambda n: b"!" * n,
    },
    "json": {
        "scene": _scene,
        "lists": lambda n: b"[" + b"[]," * n + b"[]]",
        "deep": lambda n: b"[" * n,
        "numbers": lambda n: b"[" + b"1," * n + b"1]",
        "digits": lambda n: b"1" * n,
        "fraction": lambda n: b"0." + b"1" * n,
        "members": lambda n: b"{" + b",".join(b'"%d":1' % k for k in range(n)) + b"}",
        "text": lambda n: b'"' + b"a" * n + b'"',
        "escapes": lambda n: b'"' + b"\\u00e4" * n + b'"',
        "backslashes": lambda n: b'"' + b"\\" * n,
        "blanks": lambda n: b" " * n + b"x",
        "quotes": lambda n: b'["' + b'","' * n + b'"]',
    },
    "webhook url": {
        "host": lambda n: b"http://" + b"a" * n,
        "labels": lambda n: b"http://" + b"a." * n,
        "path": lambda n: b"http://a/" + b"../" * n,
        "users": lambda n: b"http://" + b"a@" * n,
        "brackets": lambda n: b"http://" + b"[" * n,
        "ports": lambda n: b"http://a" + b":8" * n,
        "escapes": lambda n: b"http://a/" + b"%2e" * n,
    },
}
# Of these the bytes choose a fault and are not the file that is read
NOT_BY_SIZE = frozenset({"template npz"})


def growing(target: str) -> dict[str, Make]:
    """Return the inputs of any size for a target, by name."""
    kind = target.split()[-1]
    ending = {"landmarks json": {".json", ".ljson"}, "live link": {".csv"}}.get(
        target, {f".{kind}"}
    )
    found = {name: FILES[name] for name in FILES if PurePath(name).suffix in ending}
    return OTHERS.get(target) or found
