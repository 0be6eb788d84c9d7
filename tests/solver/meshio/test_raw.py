"""Raw readers: the same mesh out of every format, and a fault named where it is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from solver.errors import InputError
from solver.meshio.obj import write_obj
from solver.meshio.raw import mend, read_raw
from solver.surface import Surface

BALL = trimesh.creation.icosphere(subdivisions=3, radius=90.0)
VERTICES = np.asarray(BALL.vertices)
FACES = np.asarray(BALL.faces, np.int64)


def coloured() -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    shades = np.linspace(0, 255, len(VERTICES)).astype(np.uint8)
    mesh.visual.vertex_colors = np.column_stack([shades, shades, shades])
    return mesh


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "ascii.ply", "a.stl", "ascii.stl", "a.glb"])
def test_every_format_holds_the_same_surface(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "ascii.ply":
        path.write_bytes(trimesh.exchange.ply.export_ply(coloured(), encoding="ascii"))
    else:
        coloured().export(path, file_type="stl_ascii" if name == "ascii.stl" else None)
    scan = read_raw(path)
    assert scan.vertices.shape == VERTICES.shape
    assert scan.mm_per_unit == (1000.0 if name == "a.glb" else None)
    corners = np.sort(scan.vertices[scan.faces].reshape(-1, 9), axis=0)
    np.testing.assert_allclose(corners, np.sort(VERTICES[FACES].reshape(-1, 9), axis=0), atol=1e-4)
    signed = np.einsum("ij,ij->i", scan.vertices[scan.faces[:, 0]], normals(scan)).sum()
    assert signed > 0  # still outward
    if not name.endswith(".stl"):
        assert scan.colours is not None
        assert scan.colours[-1] == pytest.approx(1.0)


def normals(scan) -> np.ndarray:
    a, b, c = (scan.vertices[scan.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def test_obj_with_polygons_negative_numbers_groups_and_continued_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "o box\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\r\nv 1 1 0 0 0 1\nv 0 1 0 1 1 1\nv 0 2 \\\n0 1 1 1\n"
        "vt 0 0\ng quad\nf 1/1 2/1 3/1 4/1\ng empty\ng pentagon\nf -5/1/2 -4 -3//1 -1 -2\n"
    )
    scan = read_raw(path)
    np.testing.assert_array_equal(
        scan.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3]]
    )
    assert scan.empty_groups == ("empty",)
    np.testing.assert_array_equal(scan.colours[1], [0, 1, 0])


def test_obj_colours_stand_last_whether_a_vertex_has_a_weight_or_not(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0 1 .1 .2 .3\nv 1 0 0 .4 .5 .6\nv 1 1 0 .7 .8 .9\nf 1 2 3\n")
    np.testing.assert_allclose(
        read_raw(path).colours, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]
    )


def test_ply_of_mixed_polygons_with_other_elements(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = (
        "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\nproperty float nx\n"
        "property float ny\nproperty float nz\nelement face 2\nproperty uchar flags\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = "35\n0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0 0 0 1\n7 4 0 1 2 3\n7 3 0 1 2\n"
    path.write_text(header + rows)
    scan = read_raw(path)
    np.testing.assert_array_equal(scan.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    np.testing.assert_array_equal(scan.normals[:, 2], 1)


def test_binary_ply_with_polygons_of_different_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\n"
        b"property float y\nproperty float z\nelement face 2\n"
        b"property list uchar int vertex_index\nend_header\n"
    )
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4").tobytes()
    polygons = b"\x03" + np.array([0, 1, 2], "<i4").tobytes()
    polygons += b"\x04" + np.array([0, 1, 2, 3], "<i4").tobytes()
    path.write_bytes(header + points + polygons)
    np.testing.assert_array_equal(read_raw(path).faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])
    path.write_bytes((header + points + polygons)[:-5])
    assert fault(path).code == "scan.truncated"


def test_glb_puts_every_part_in_its_place(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    mesh = trimesh.Trimesh(VERTICES * 1e-3, FACES, process=False)
    scene.add_geometry(mesh)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = 0.5
    scene.add_geometry(mesh.copy(), transform=mirror)
    scene.export(tmp_path / "a.glb")
    scan = read_raw(tmp_path / "a.glb")
    assert len(scan.vertices) == 2 * len(VERTICES)
    assert np.ptp(scan.vertices[:, 0]) == pytest.approx(0.68, abs=1e-6)
    outward = np.einsum(
        "ij,ij->i", scan.vertices[scan.faces[:, 0]] - np.array([[0.5, 0, 0]]), normals(scan)
    )[len(FACES) :]
    assert (outward > 0).all()  # a mirroring node turns no surface inside out


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "x,y,z\n1,2,3\n4,5,6\n",
        "# cloud\n1;2;3\n4;5;6",
        "2\n1 2 3 17 255 0 0\n4 5 6 18 0 0 255\n",
        "1 2 3 0 0.6 -0.8 10 20 30\n4 5 6 0 0 1 40 50 60\n",
        "\ufeff1 2 3\n4 5 6\n",
    ],
)
def test_point_clouds_as_text(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(text, encoding="utf-8")
    scan = read_raw(path)
    np.testing.assert_array_equal(scan.vertices, [[1, 2, 3], [4, 5, 6]])
    assert len(scan.faces) == 0
    assert (scan.normals is not None) == ("-0.8" in text)
    assert (scan.colours is not None) == (len(text.split("\n")[1].split()) > 6)


@pytest.mark.parametrize(
    ("name", "text", "code", "line"),
    [
        ("a.obj", "v 0 0 0\nv 1 x 0\nv 1 1 0\nf 1 2 3\n", "scan.unreadable", 2),
        ("a.obj", "v 0 0 0\nv 1 0\nv 1 1 0\nf 1 2 3\n", "scan.unreadable", 2),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2\n", "scan.unreadable", 4),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n", "scan.truncated", 4),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\nf 2", "scan.truncated", 5),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1", "scan.truncated", 3),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nvn 0 0 1\n", "scan.truncated", None),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 1\n", "scan.truncated", None),
        ("a.obj", "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\n", "scan.truncated", None),
        ("a.obj", "v 0 0 \\\n0\nv nan 0 0\nv 1 x 0\nf 1 2 3\n", "scan.unreadable", 4),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 2.5\n", "scan.unreadable", 4),
        ("a.xyz", "0 0 0\n1 2 3\n1 oops 3\n1 2 3\n", "scan.unreadable", 3),
        ("a.xyz", "0 0 0\n1 2 3\n1 2", "scan.truncated", 3),
        ("a.pts", "5\n0 0 0\n1 2 3\n", "scan.truncated", None),
        ("a.csv", "x;y;z\n10,058;-10,568;51,234\n", "scan.unreadable", 2),
        ("a.xyz", "10,058 -10,568 51,234\n", "scan.unreadable", 1),
        ("a.obj", "nothing\n", "scan.empty", None),
        ("a.fbx", "v 0 0 0\n", "scan.format", None),
    ],
)
def test_faults_are_named_with_their_line(
    name: str, text: str, code: str, line: int | None, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text)
    error = fault(path)
    assert error.code == code
    assert error.context.get("line") == line
    assert name in error.message


def test_a_mark_of_byte_order_costs_no_vertex(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("\ufeffv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", encoding="utf-8")
    assert len(read_raw(path).vertices) == 3


def test_a_colour_a_little_above_one_makes_no_scan_black(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0 0.5 0.2 1.000001\nv 1 0 0 1 1 1\nv 1 1 0 0 0 0\nf 1 2 3\n")
    colours = read_raw(path).colours
    assert colours is not None
    np.testing.assert_allclose(colours[0], [0.5, 0.2, 1.0])


@pytest.mark.parametrize(
    ("kind", "length", "code"),
    [("uint", b"\xff\xff\xff\xff", "scan.truncated"), ("float", bytes(4), "scan.unreadable")],
)
def test_ply_list_of_no_possible_length(
    kind: str, length: bytes, code: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.ply"
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list {kind} int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + bytes(36) + length + bytes(12))
    assert fault(path).code == code


def test_nan_is_kept_by_the_reader_and_mended_with_its_triangles(tmp_path: Path) -> None:
    vertices = VERTICES.copy()
    vertices[17, 1] = math.nan
    write_obj(tmp_path / "a.obj", Surface(vertices, FACES))
    scan = read_raw(tmp_path / "a.obj")
    assert math.isnan(scan.vertices[17, 1])
    mended, counts = mend(scan)
    assert (counts.not_finite, counts.first_not_finite) == (1, 17)
    assert len(mended.vertices) == len(VERTICES) - 1
    assert len(mended.faces) == len(FACES) - (FACES == 17).any(axis=1).sum()
    np.testing.assert_array_equal(mended.vertices[17], VERTICES[18].round(6))


def test_stored_normals_without_a_length_are_none(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    write_obj(path, Surface(VERTICES, FACES))
    scan = replace(read_raw(path), normals=np.zeros_like(VERTICES))
    assert mend(scan)[0].normals is None
    some = np.where(np.arange(len(VERTICES))[:, None] % 5, VERTICES, 0.0)
    assert mend(replace(scan, normals=some))[0].normals is not None


def test_loose_triangles_are_joined_and_wound_alike(tmp_path: Path) -> None:
    faces = FACES.copy()
    faces[::9] = faces[::9, ::-1]
    corners = VERTICES[faces].reshape(-1, 3)
    loose = Surface(corners, np.arange(len(corners)).reshape(-1, 3))
    write_obj(tmp_path / "a.obj", loose)
    mended, counts = mend(read_raw(tmp_path / "a.obj"))
    assert len(mended.vertices) == len(VERTICES)
    assert counts.duplicate == len(corners) - len(VERTICES)
    assert counts.flipped == len(FACES[::9])
    assert np.einsum("ij,ij->i", mended.vertices[mended.faces[:, 0]], normals(mended)).min() > 0


def fault(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        read_raw(path)
    return caught.value
