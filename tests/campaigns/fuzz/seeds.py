"""Small valid inputs, one of every kind that a reader knows: mutations start from them."""

from __future__ import annotations

import base64
import io
import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import trimesh
from PIL import Image, ImageCms

from solver.animation.performance import FORMATS
from solver.mechanics.boundary import JAW_FREEDOM
from solver.model import SubjectModel
from solver.neck.builtin import builtin_neck
from solver.rig.frames.animation import write_video
from solver.scans.live_link import ARKIT_NAMES, FaceTake, write_signals
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.scans.markers.readers.take import Take
from solver.scans.openface import GAZE, INTENSITIES, POSE
from solver.similarity import IDENTITY
from tests import take_files
from tests.ball_head import ball_head
from tests.osim_file import osim_text


@cache
def person() -> SubjectModel:
    """Return a small person, to whom marker sets are bound."""
    return SubjectModel.load(Path(__file__).parents[2] / "fixtures" / "small_model.npz")


@cache
def surface() -> trimesh.Trimesh:
    """Return a closed surface the size of a face, in mm."""
    return _ball(90.0)


def obj() -> list[bytes]:
    """Return OBJ files: exported ones, and one with what people write by hand."""
    by_hand = (
        b"# a\nmtllib a.mtl\no box\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\r\nv 1 1 0 0 0 1\n"
        b"v 0 2 \\\n0 1 1 1\nvt 0 0\nvn 0 0 1\ng quad\nusemtl m\ns off\nf 1/1/1 2/1 3//1 4\n"
        b"f -1 -2 -3\ng empty\n"
    )
    return [_exported("obj"), by_hand]


def ply() -> list[bytes]:
    """Return PLY files: text and both byte orders, with properties and lists of all kinds."""
    export = trimesh.exchange.ply.export_ply
    mixed = (
        b"ply\nformat ascii 1.0\ncomment c\nelement camera 1\nproperty float f\nelement vertex 4\n"
        b"property float x\nproperty double y\nproperty float z\nproperty float nx\n"
        b"property float ny\nproperty float nz\nproperty float confidence\nelement face 2\n"
        b"property uchar flags\nproperty list uchar int vertex_indices\nend_header\n"
        b"35\n0 0 0 0 0 1 1\n1 0 0 0 0 1 1\n1 1 0 0 0 1 0\n0 1 0 0 0 1 1\n7 4 0 1 2 3\n7 3 0 1 2\n"
    )
    head = (
        b"ply\nformat %s 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n"
    )
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    orders = {b"binary_little_endian": "<", b"binary_big_endian": ">"}
    binary = [
        head % name
        + points.astype(f"{order}f4").tobytes()
        + b"\x03"
        + np.array([0, 1, 2], f"{order}i4").tobytes()
        + b"\x04"
        + np.array([0, 1, 2, 3], f"{order}i4").tobytes()
        for name, order in orders.items()
    ]
    return [export(surface()), export(surface(), encoding="ascii"), mixed, *binary]


def stl() -> list[bytes]:
    """Return STL files, binary and text."""
    return [_exported("stl"), _exported("stl_ascii")]


def glb() -> list[bytes]:
    """Return GLB files with one mesh and with two that are moved."""
    metres = _ball(0.09)
    scene = trimesh.Scene()
    scene.add_geometry(metres)
    scene.add_geometry(metres.copy(), transform=np.diag([-1.0, 1.0, 2.0, 1.0]))
    return [_exported("glb", metres), _exported("glb", scene)]


def xyz() -> list[bytes]:
    """Return point clouds as text."""
    return [
        b"1 2 3\n4 5 6\n",
        b"x,y,z\n1,2,3\n4,5,6\n",
        b"# cloud\n1;2;3\n4;5;6",
        b"2\n1 2 3 17 255 0 0\n4 5 6 18 0 0 255\n",
        b"1 2 3 0 0.6 -0.8 10 20 30\n4 5 6 0 0 1 40 50 60\n",
    ]


def landmarks_json() -> list[bytes]:
    """Return landmarks by name and the 68 of ``ljson``."""
    named = {"nose_tip": [0, 0, 100.5], "chin": [0, -60, 80]}
    groups = {"groups": {"LJSON": {"landmarks": {"points": [[0, 1, 2]] * 68}}}}
    contents = [named, {"landmarks": named}, groups]
    return [json.dumps(content).encode() for content in contents]


def landmarks_csv() -> list[bytes]:
    """Return landmarks as a table."""
    return [b"name,x,y,z\nnose_tip,0,0,100.5\nchin,0,-60,80\n", b"chin,1,2,3"]


def live_link() -> list[bytes]:
    """Return recordings of two frames, without angles and with them."""
    header = ["Timecode", "BlendShapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES)]
    weights = ["0.5"] * len(ARKIT_NAMES)
    rows = [header, ["23:59:59:58.0", "52", *weights], ["00:00:00:01.0", "52", *weights]]
    angles = ["HeadYaw", "HeadPitch", "HeadRoll"], ["0.1", "-0.2", "0.3"], ["0", "1e-9", "-0.0"]
    turned = [row + more for row, more in zip(rows, angles, strict=True)]
    return ["\r\n".join(",".join(row) for row in table).encode() for table in (rows, turned)]


def signals() -> list[bytes]:
    """Return the signals of a video of two frames, of which one shows a face."""
    turns = np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.0]])
    weights = np.full((2, len(ARKIT_NAMES)), 0.5)
    eyes = np.zeros((2, 2, 3))
    take = FaceTake(np.array([0.0, 0.04]), weights, turns, eyes, np.arange(2) == 0, "video")
    with tempfile.TemporaryDirectory() as folder:
        write_signals(path := Path(folder) / "signals.csv", take)
        return [path.read_bytes()]


def films() -> list[bytes]:
    """Return a film of a few small frames."""
    pictures = [np.full((96, 64, 3), 0.2 * number) for number in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        write_video(path := Path(folder) / "film.mp4", pictures, (64, 96), 25.0)
        return [path.read_bytes()]


def osim() -> list[bytes]:
    """Return a neck of OpenSim with two muscles."""
    return [neck_of(2)]


def neck_of(muscles: int) -> bytes:
    """Return a neck of OpenSim with so many muscles, of which every other is the same."""
    neck = builtin_neck()
    pairs = neck.muscles[:2] * (muscles // 2 + 1)
    return osim_text(replace(neck, muscles=pairs[:muscles])).encode()


def openface() -> list[bytes]:
    """Return recordings of three frames, of one face, and of those in pictures."""
    clock = ["frame", "face_id", "timestamp", "confidence", "success"]
    frames = [row.split() for row in ("1 0 0 0.98 1", "2 0 0.03 0.4 0", "3 0 0.07 1 1")]
    found = []
    for first in (0, 2):
        header = [*clock[first:], *POSE, *GAZE, *INTENSITIES]
        rest = ["0.1", *["-0.5"] * 8, *["1.5"] * len(INTENSITIES)]
        table = [header, *([*frame[first:], *rest] for frame in frames)]
        found.append("\r\n".join(", ".join(row) for row in table).encode())
    return found


def markers_c3d() -> list[bytes]:
    """Return C3D files of all processors, of floats and integers, with analog data."""
    points = take_files.face_points(6, 4)
    processors = (take_files.INTEL, take_files.DEC, take_files.MIPS)
    return [
        take_files.c3d_bytes(points, processor=processor, scale=scale, analog=(2, 3))
        for processor in processors
        for scale in (-1.0, 0.05)
    ]


def markers_trc() -> list[bytes]:
    """Return TRC files, with tabs and with blanks."""
    content = take_files.trc_bytes(take_files.face_points(6, 4))
    return [content, content.replace(b"\t", b" ")]


def known_activations() -> list[bytes]:
    """Return tables of known activations, by time and by expression."""
    by_time = [f"frontalis,left,{0.05 * number},0.1,0.05\n" for number in range(20)]
    by_name = "muscle,expression,value,sd\nprocerus,smile,0.2,0.1\nfrontalis_l.medial,,-0.1,0.1\n"
    return ["".join(["muscle,side,time,value,sd\n", *by_time]).encode(), by_name.encode()]


PICTURE = (96, 72)  # px


def _picture() -> Image.Image:
    columns, rows = np.meshgrid(*map(np.arange, PICTURE))
    return Image.fromarray(np.stack([2 * columns, 3 * rows, columns + rows], 2).astype(np.uint8))


def _as_file(image: Image.Image, form: str, **more: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **more)
    return stream.getvalue()


def _exif() -> Image.Exif:
    """Return tags of a picture that lies on its side, a whole frame of a known focal length."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x8769] = {0xA405: 50, 0xA002: PICTURE[0], 0xA003: PICTURE[1], 0x920A: 24.0}
    return exif


def pictures_jpg() -> list[bytes]:
    """Return JPEGs in colour, inks and grey, in passes, and with a second picture behind."""
    image = _picture()
    return [
        _as_file(image, "JPEG", exif=_exif()),
        _as_file(image, "JPEG", progressive=True),
        _as_file(image.convert("CMYK"), "JPEG"),
        _as_file(image.convert("L"), "JPEG"),
        _as_file(image, "MPO", save_all=True, append_images=[image]),
    ]


def pictures_png() -> list[bytes]:
    """Return PNGs of every depth, one with a profile of colours, and one that is animated."""
    image = _picture()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    deep = Image.fromarray(257 * np.asarray(image.convert("L")).astype(np.uint16))
    return [
        _as_file(image, "PNG", exif=_exif(), icc_profile=profile),
        *(_as_file(image.convert(mode), "PNG") for mode in ("P", "1", "LA", "RGBA")),
        _as_file(deep, "PNG"),
        _as_file(image, "PNG", save_all=True, append_images=[deep.convert("RGB")]),
    ]


def photograph_json() -> list[bytes]:
    """Return what is known of a photograph, with landmarks by name and in a list."""
    places = {"33": [30, 20], "263": [60, 20], "61": [38, 50], "291": [52, 50]}
    camera = {"fx": 90.0, "fy": 91.0, "distortion": [-0.1, 0.01, 0.0, 0.0, 0.0]}
    curve = [[38, 50], [45, 45], [52, 50], [45, 55], [38, 50]]
    document = {"size": PICTURE, "camera": camera, "curves": {"lips_outer": curve}}
    mesh = [[30 + 0.05 * number, 20 + 0.05 * number] for number in range(478)]
    return [
        json.dumps({**document, "landmarks": landmarks}).encode() for landmarks in (places, mesh)
    ]


def markers_motive() -> list[bytes]:
    """Return CSV files of older and newer releases."""
    points = take_files.face_points(6, 4)
    return [take_files.motive_bytes(points, newer=newer) for newer in (False, True)]


def markers_npz() -> list[bytes]:
    """Return landmarks, and a take as the project keeps it."""
    points = take_files.face_points(6, 4)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.npz"
        Take("a", ("b", "c", "d", "e"), points, 60.0).save(path)
        kept = path.read_bytes()
    return [take_files.npz_bytes(points, sigma=np.ones(3), rate=30.0, unit="mm", first=3), kept]


def marker_set() -> list[bytes]:
    """Return a marker set with a marker of the skin and one of a bone."""
    skin = Marker("LBRO1", (1, 2, 3), (0.2, 0.3, 0.5), 2.0)
    bone = Marker("HEAD1", part="head", place_mm=(1.0, 2.0, 3.0))
    markers = MarkerSet((skin, bone), IDENTITY, person().sha256)
    return [json.dumps(markers.to_document()).encode()]


def sequence() -> list[bytes]:
    """Return fitted sequences of two frames, with blended and with fibre muscles."""
    return [sequence_bytes(2, 2, entries) for entries in ((6,), ())]


def sequence_bytes(frames: int, muscles: int, entries: tuple[int, ...] = (6,)) -> bytes:
    """Return a fitted sequence at rest."""
    numbers = np.arange(frames)
    stream = io.BytesIO()
    np.savez(
        stream,
        format=np.array(FORMATS[-1]),
        muscles=np.array([f"m{number}" for number in range(muscles)]),
        frame=numbers,
        time=numbers / 60.0,
        status=np.full(frames, "fitted"),
        activations=np.ones((frames, muscles, *entries)),
        jaw=np.zeros((frames, JAW_FREEDOM)),
        head=np.zeros((frames, 6)),
    )
    return stream.getvalue()


def npy() -> list[bytes]:
    """Return arrays of frames, of both orders and of other types."""
    frames = np.zeros((2, len(surface().vertices), 3), np.float32) + np.asarray(surface().vertices)
    arrays = [frames, frames.astype(">f8"), np.asfortranarray(frames), frames.astype(np.int16)]
    return [_saved(array) for array in arrays]


def npz() -> list[bytes]:
    """Return archives as the project writes them, packed and not."""
    header = np.frombuffer(json.dumps({"format": 1, "name": "a"}).encode(), np.uint8)
    x = np.arange(12.0).reshape(4, 3)
    names = np.array(["a", "b"])
    contents = []
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, header=header, x=x, names=names)
        contents.append(stream.getvalue())
    return contents


def template() -> list[bytes]:
    """Return a ZIP of the beginnings of a template, packed and not."""
    files = {
        "template.toml": 'format = 1\nunit = "mm"\nup = "y"\nforward = "z"\n',
        "skin.obj": _exported("obj").decode(),
        "parts.json": json.dumps({"flesh": [0, 1, 2], "face": [0]}),
        "folder/landmarks.csv": "name,vertex\nnose_tip,3\n",
    }
    contents = []
    for method in (ZIP_STORED, ZIP_DEFLATED):
        stream = io.BytesIO()
        with ZipFile(stream, "w", method) as archive:
            for name, text in files.items():
                archive.writestr(name, text)
        contents.append(stream.getvalue())
    return contents


def template_arrays() -> list[bytes]:
    """Return a template as it is stored."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "template.npz"
        ball_head().save(path)
        return [path.read_bytes()]


def metadata() -> list[bytes]:
    """Return what ``Upload-Metadata`` holds."""
    name, sha256 = (base64.b64encode(text).decode() for text in (b"smile.obj", b"a" * 64))
    return [
        f"filename {name}".encode(),
        f"filename {name},sha256 {sha256}, is_confidential".encode(),
    ]


def checksum() -> list[bytes]:
    """Return what ``Upload-Checksum`` holds."""
    return [
        f"sha256 {base64.b64encode(b'x' * 32).decode()}".encode(),
        b"sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=",
    ]


def cursor() -> list[bytes]:
    """Return cursors of lists."""
    text = b"2026-11-21T19:00:00.123456+00:00 8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"
    return [base64.urlsafe_b64encode(text), base64.urlsafe_b64encode(text[:19] + text[32:])]


def bodies() -> list[bytes]:
    """Return JSON bodies."""
    return [
        b'{"name": "Alex", "template_id": null}',
        b'{"kind": "fit_geometry", "options": {"a": [1, 2.5e3, {"b": "\\u00e4\\ud83d\\ude00"}]}}',
    ]


def urls() -> list[bytes]:
    """Return addresses of webhooks."""
    return [
        b"https://hooks.studio.example:8443/in?a=1#x",
        b"http://user:pass@[::ffff:127.0.0.1]:80/%2e%2e/",
        b"https://2130706433/",
    ]


def _ball(radius: float) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    shades = np.linspace(0, 255, len(ball.vertices)).astype(np.uint8)
    colours = np.column_stack([shades, shades, shades])
    return trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=colours, process=False)


def _exported(kind: str, shape: trimesh.Trimesh | trimesh.Scene | None = None) -> bytes:
    content: Any = (shape or surface()).export(file_type=kind)
    return content.encode() if isinstance(content, str) else bytes(content)


def _saved(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()
