"""Strict readers: the vertices come back in order, or an InputError says where the fault is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from solver.errors import InputError
from solver.meshio.obj import write_obj
from solver.meshio.registered import REGISTERED_FORMATS, read_registered, write_registered
from solver.model import SizeFrom
from solver.surface import Surface
from tests.fixtures import small_capture

BALL = trimesh.creation.icosphere(subdivisions=2, radius=90.0)
HEAD = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
COUNT = len(HEAD.vertices)


def write(path: Path, surface: Surface, *, ascii_form: bool = False) -> Path:
    """Write a scan with a tool that is not ours (OBJ apart, where trimesh merges vertices)."""
    if path.suffix == ".obj":
        write_obj(path, surface)
        return path
    scale = 1e-3 if path.suffix == ".glb" else 1.0
    mesh = trimesh.Trimesh(surface.vertices * scale, surface.faces, process=False)
    if ascii_form and path.suffix == ".ply":
        path.write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="ascii"))
    elif ascii_form:
        mesh.export(path, file_type="stl_ascii")
    else:
        mesh.export(path)
    return path


def fault(path: Path, **options: np.ndarray) -> InputError:
    with pytest.raises(InputError) as caught:
        read_registered(path, HEAD.faces, COUNT, **options)
    error = caught.value
    assert error.context["file"] == path.name
    assert path.name in error.message
    json.dumps(error.as_dict(), allow_nan=False)
    return error


FORMS = [(suffix, False) for suffix in REGISTERED_FORMATS] + [(".ply", True), (".stl", True)]


@pytest.mark.parametrize(("suffix", "ascii_form"), FORMS)
def test_vertices_come_back_in_order(suffix: str, ascii_form: bool, tmp_path: Path) -> None:
    path = write(tmp_path / f"head{suffix}", HEAD, ascii_form=ascii_form)
    vertices = read_registered(path, HEAD.faces, COUNT, neutral=HEAD.vertices).vertices
    assert vertices.dtype == np.float64
    np.testing.assert_allclose(vertices, HEAD.vertices, atol=1e-4)


def test_a_big_endian_ply_is_read(tmp_path: Path) -> None:
    path = tmp_path / "head.ply"
    header = ["ply", "format binary_big_endian 1.0", f"element vertex {COUNT}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(HEAD.faces)}", "property list uchar int vertex_indices"]
    faces = np.zeros(len(HEAD.faces), [("count", "u1"), ("corners", ">i4", 3)])
    faces["count"] = 3
    faces["corners"] = HEAD.faces
    content = "\n".join([*header, "end_header\n"]).encode()
    path.write_bytes(content + HEAD.vertices.astype(">f4").tobytes() + faces.tobytes())
    vertices = read_registered(path, HEAD.faces, COUNT, neutral=HEAD.vertices).vertices
    np.testing.assert_allclose(vertices, HEAD.vertices, atol=1e-4)


def test_blank_lines_after_an_ascii_stl_are_no_cut(tmp_path: Path) -> None:
    path = write(tmp_path / "head.stl", HEAD, ascii_form=True)
    path.write_bytes(path.read_bytes() + b"\n\n")
    assert len(read_registered(path, HEAD.faces, COUNT).vertices) == COUNT


@pytest.mark.parametrize("suffix", REGISTERED_FORMATS)
def test_a_whole_head_survives_every_format(suffix: str, tmp_path: Path) -> None:
    neutral = small_capture("neutral")
    smile = small_capture("smile")
    path = write(tmp_path / f"smile{suffix}", smile)
    vertices = read_registered(
        path, smile.faces, len(smile.vertices), neutral=neutral.vertices
    ).vertices
    np.testing.assert_allclose(vertices, smile.vertices, atol=1e-4)


def test_obj_with_texture_colours_negative_numbers_and_comments(tmp_path: Path) -> None:
    rows = [f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in HEAD.vertices]
    faces = [f"f\t{a - COUNT}/1/1 {b - COUNT}//2 {c - COUNT}" for a, b, c in HEAD.faces]
    path = tmp_path / "head.obj"
    text = "\r\n".join(["# Gesicht \xfc", "mtllib a.mtl", "vt 0 0", *rows, "s off", *faces])
    path.write_bytes(text.encode("latin-1"))
    np.testing.assert_array_equal(read_registered(path, HEAD.faces, COUNT).vertices, HEAD.vertices)


def test_glb_transform_of_the_node_is_applied(tmp_path: Path) -> None:
    mesh = trimesh.Trimesh(HEAD.vertices * 1e-3, HEAD.faces, process=False)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    turn[:3, 3] = [0.1, 0.2, 0.3]
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=turn)
    path = tmp_path / "head.glb"
    scene.export(path)
    expected = HEAD.vertices @ turn[:3, :3].T + 1000 * turn[:3, 3]
    np.testing.assert_allclose(
        read_registered(path, HEAD.faces, COUNT).vertices, expected, atol=1e-3
    )


@pytest.mark.parametrize("value", ["nan", "inf", "-Infinity"])
def test_nan_in_obj_names_line_and_vertex(value: str, tmp_path: Path) -> None:
    path = write(tmp_path / "head.obj", HEAD)
    lines = path.read_text().splitlines()
    lines[18] = f"v 1.0 {value} 2.0"
    path.write_text("\n".join(lines))
    error = fault(path)
    assert (error.code, error.context["line"], error.context["vertex"]) == ("scan.nan", 19, 17)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
def test_nan_in_binary_names_the_vertex(suffix: str, tmp_path: Path) -> None:
    vertices = HEAD.vertices.copy()
    vertices[17, 1] = math.nan
    error = fault(write(tmp_path / f"head{suffix}", HEAD.with_vertices(vertices)))
    assert error.code == "scan.nan"
    assert suffix == ".stl" or error.context["vertex"] == 17


@pytest.mark.parametrize("suffix", REGISTERED_FORMATS)
def test_wrong_vertex_count_says_both_counts(suffix: str, tmp_path: Path) -> None:
    other = trimesh.creation.icosphere(subdivisions=1, radius=90.0)
    surface = Surface(np.asarray(other.vertices), np.asarray(other.faces, np.int64))
    error = fault(write(tmp_path / f"head{suffix}", surface))
    assert error.code == "scan.vertex_count"
    assert error.context["expected"] == (len(HEAD.faces) if suffix == ".stl" else COUNT)


@pytest.mark.parametrize("suffix", REGISTERED_FORMATS)
def test_empty_and_cut_short(suffix: str, tmp_path: Path) -> None:
    path = write(tmp_path / f"head{suffix}", HEAD)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 4])
    assert fault(path).code in ("scan.truncated", "scan.unreadable", "scan.vertex_count")
    path.write_bytes(b"")
    assert fault(path).code == "scan.empty"


@pytest.mark.parametrize(
    ("factor", "hint"), [(1e-3, "metres"), (0.1, "centimetres"), (50.0, "cannot be a head")]
)
def test_wrong_unit_has_a_hint(factor: float, hint: str, tmp_path: Path) -> None:
    error = fault(write(tmp_path / "head.ply", HEAD.with_vertices(HEAD.vertices * factor)))
    assert error.code == "scan.unit"
    assert hint in error.message


def test_shuffled_vertices_are_refused(tmp_path: Path) -> None:
    shuffled = np.random.default_rng(0).permutation(HEAD.vertices)
    assert (
        fault(write(tmp_path / "head.ply", HEAD.with_vertices(shuffled))).code
        == "scan.vertex_order"
    )
    shuffled_faces = Surface(HEAD.vertices, HEAD.faces[::-1].copy())
    assert fault(write(tmp_path / "head.stl", shuffled_faces)).code == "scan.vertex_order"


def test_an_expression_off_the_neutral_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "head.obj", HEAD.with_vertices(HEAD.vertices + np.array([0, 40, 0])))
    error = fault(path, neutral=HEAD.vertices)
    assert error.code == "scan.misaligned"
    assert "moved by 40 mm" in error.message


@pytest.mark.parametrize("axis", [0, 2], ids=["left and right", "inside out"])
def test_a_mirrored_expression_is_refused(axis: int, tmp_path: Path) -> None:
    mirror = np.ones(3)
    mirror[axis] = -1.0
    path = write(tmp_path / "head.obj", HEAD.with_vertices(HEAD.vertices * mirror))
    error = fault(path, neutral=HEAD.vertices)
    assert error.code == "scan.mirrored"
    assert "head.obj" in error.message


def test_announced_counts_are_checked_before_memory_is_taken(tmp_path: Path) -> None:
    huge = 10**11
    ply = tmp_path / "head.ply"
    for form in ("ascii", "binary_little_endian"):
        header = f"ply\nformat {form} 1.0\nelement vertex {huge}\n"
        ply.write_text(
            header + "property float x\nproperty float y\nproperty float z\nend_header\n"
        )
        assert fault(ply).code == "scan.truncated"
    stl = tmp_path / "head.stl"
    stl.write_bytes(b"\0" * 80 + (2**32 - 1).to_bytes(4, "little"))
    assert fault(stl).code == "scan.truncated"


def test_unknown_format_and_missing_file(tmp_path: Path) -> None:
    assert fault(tmp_path / "head.fbx").code == "scan.format"
    assert fault(tmp_path / "head.obj").code == "scan.unreadable"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    folder = tmp_path_factory.mktemp("seeds")
    small = trimesh.creation.icosphere(subdivisions=0, radius=90.0)
    surface = Surface(np.asarray(small.vertices), np.asarray(small.faces, np.int64))
    return {
        suffix: [
            write(folder / f"head{suffix}", surface, ascii_form=form).read_bytes()
            for form in (False, True)[: 2 if suffix in (".ply", ".stl") else 1]
        ]
        for suffix in REGISTERED_FORMATS
    }


@pytest.mark.long
@settings(
    max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_only_input_errors_leave_the_readers(
    data: st.DataObject, seeds: dict[str, list[bytes]], tmp_path: Path
) -> None:
    suffix = data.draw(st.sampled_from(REGISTERED_FORMATS))
    content = bytearray(data.draw(st.sampled_from(seeds[suffix])))
    junk = st.one_of(
        st.binary(max_size=8),
        st.sampled_from([b"-1", b"1e308", b"nan", b"[]", b"{}", b"null", b"999999999999", b"\n"]),
    )
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 12))] = data.draw(junk)
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / f"head{suffix}"
    path.write_bytes(content)
    small = trimesh.creation.icosphere(subdivisions=0)
    try:
        vertices = read_registered(path, np.asarray(small.faces, np.int64), 12).vertices
    except InputError as error:
        json.dumps(error.as_dict(), allow_nan=False)
    else:
        assert vertices.shape == (12, 3)
        assert np.isfinite(vertices).all()


def test_confidence_comes_back_and_is_one_where_nothing_is_said(tmp_path: Path) -> None:
    confidence = np.linspace(0.0, 1.0, COUNT)
    write_registered(tmp_path / "a.ply", HEAD, confidence)
    found = read_registered(tmp_path / "a.ply", HEAD.faces, COUNT)
    np.testing.assert_array_equal(found.vertices, HEAD.vertices)
    np.testing.assert_allclose(found.confidence, confidence, atol=1e-7)
    plain = read_registered(write(tmp_path / "b.ply", HEAD), HEAD.faces, COUNT)
    assert (plain.confidence == 1.0).all()


@pytest.mark.parametrize("size_from", ["scan", "template", "guess"])
def test_a_registered_scan_says_where_its_size_comes_from(
    size_from: SizeFrom, tmp_path: Path
) -> None:
    write_registered(tmp_path / "a.ply", HEAD, np.ones(COUNT), size_from)
    assert read_registered(tmp_path / "a.ply", HEAD.faces, COUNT).size_from == size_from


@pytest.mark.parametrize("wrong", [-0.1, 1.5, np.nan])
def test_a_confidence_that_is_none_is_named(wrong: float, tmp_path: Path) -> None:
    confidence = np.ones(COUNT)
    confidence[7] = wrong
    write_registered(tmp_path / "a.ply", HEAD, confidence)
    error = fault(tmp_path / "a.ply")
    assert error.code == "scan.confidence"
    assert error.context["vertex"] == 7
