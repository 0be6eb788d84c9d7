"""BodyParts3D and ICT-FaceKit as their owners publish them, against the plain form of the data."""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from solver.errors import InputError
from solver.surface import Floats, Ints
from solver.templates import bodyparts3d, ict_facekit
from solver.templates.bodyparts3d import public_parts
from solver.templates.ict_facekit import NEUTRAL
from solver.templates.tables import obj_texture, public_files
from tests.fixtures import data_folder


def obj(vertices: Floats, polygons: Ints) -> str:
    """Return an OBJ as the two sources write it: with normals or texture, -1 where no corner is."""
    lines = ["# source: as published", "mtllib x.mtl"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["vn 0 0 1", "usemtl M_Face"]
    for corners in polygons.tolist():
        lines.append("f " + " ".join(f"{corner + 1}//1" for corner in corners if corner >= 0))
    return "\r\n".join(lines) + "\n"


def published_organs(target: Path) -> None:
    """Write the organs of the plain folder as an archive of release 3.0."""
    source = data_folder("bodyparts3d")
    with zipfile.ZipFile(target / "BodyParts3D_3.0_obj_99.zip", "w") as archive:
        for row in csv.DictReader((source / "index.csv").open()):
            if row["category"] in ("neck_muscle", "cervical"):
                continue  # they would only take time
            mesh = trimesh.load_mesh(source / f"{row['fma_id']}.ply", process=False)
            text = obj(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))
            archive.writestr(f"BodyParts3D_3.0_obj_99/{row['fma_id']}.obj", text)


def published_faces(target: Path, identities: int, expressions: list[str]) -> None:
    """Write some shapes of ICT-FaceKit as the published archive's OBJs."""
    with (
        np.load(data_folder("ict_facekit", "ict_facekit.npz")) as data,
        zipfile.ZipFile(target / "repository.zip", "w") as archive,
    ):
        neutral = data["V"].astype(float)
        home = "ICT-FaceKit-0123abc/FaceXModel"
        archive.writestr(f"{home}/{NEUTRAL}.obj", obj(neutral, data["quads"]))
        names = list(data["ex"])
        for name in expressions:
            shape = neutral + data["E"][names.index(name)]
            archive.writestr(f"{home}/{name}.obj", obj(shape, data["quads"][:1]))
        for number in range(identities):
            shape = neutral + data["I"][number]
            archive.writestr(f"{home}/identity{number:03d}.obj", obj(shape, data["quads"][:1]))
        archive.writestr("ICT-FaceKit-0123abc/sample_data/random.obj", "v 0 0 0\n")
        archive.writestr("__MACOSX/FaceXModel/._identity000.obj", b"\0\5\26\7")


def test_published_organs_are_those_of_the_plain_folder(tmp_path: Path) -> None:
    published_organs(tmp_path)
    found = bodyparts3d.read_parts(tmp_path)
    expected = bodyparts3d.read_parts(data_folder("bodyparts3d"))
    assert bodyparts3d.muscle_names(found) == bodyparts3d.muscle_names(expected)
    assert len(found) == 104
    for name, part in found.items():
        assert part.category == expected[name].category
        assert np.array_equal(part.surface.vertices, expected[name].surface.vertices)
        assert np.array_equal(part.surface.faces, expected[name].surface.faces)


def test_published_faces_are_those_of_the_plain_file(tmp_path: Path) -> None:
    published_faces(tmp_path, identities=2, expressions=["jawOpen", "browDown_L"])
    found = ict_facekit.read_facekit(tmp_path)
    expected = ict_facekit.read_facekit(data_folder("ict_facekit"))
    assert np.array_equal(found.skin.faces, expected.skin.faces)
    assert np.allclose(found.skin.vertices, expected.skin.vertices, atol=1e-9)
    assert list(found.deltas) == ["browDown_L", "jawOpen"]
    for name, delta in found.deltas.items():
        assert np.allclose(delta, expected.deltas[name], atol=1e-4)
    assert np.allclose(found.identities, expected.identities[:2], atol=1e-4)


def test_release_without_face_muscles_is_named(tmp_path: Path) -> None:
    (tmp_path / "FJ1252.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match=r"4\.0, which has no muscles") as caught:
        public_parts(tmp_path)
    assert caught.value.code == "anatomy.release"


def test_missing_organ_is_named(tmp_path: Path) -> None:
    (tmp_path / "FMA52748.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"FMA\d+\.obj \(") as caught:
        public_parts(tmp_path)
    assert caught.value.code == "anatomy.part"


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("v 0 0 0\nv 1 zero 0\n", 2, "not three numbers"),
        ("v 0 0 0\nv 1 nan 0\n", 2, "not finite"),
        ("v 0 0 0\nv 1 0 0\nf 1 2 3\n", 3, "none of the 2"),
        ("v 0 0 0\nf 1 1\n", 2, "2 corners"),
        ("# empty\n", 1, "no vertices"),
    ],
)
def test_fault_in_a_mesh_has_its_line(text: str, line: int, reason: str, tmp_path: Path) -> None:
    (tmp_path / f"{NEUTRAL}.obj").write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        ict_facekit.read_facekit(tmp_path)
    assert caught.value.code == "download.mesh"
    assert caught.value.context["line"] == line


def test_shape_of_another_topology_is_named(tmp_path: Path) -> None:
    (tmp_path / f"{NEUTRAL}.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (tmp_path / "jawOpen.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match=r"jawOpen\.obj has 1 vertices") as caught:
        ict_facekit.read_facekit(tmp_path)
    assert caught.value.code == "faces.topology"


def test_damaged_archive_is_named(tmp_path: Path) -> None:
    (tmp_path / "repository.zip").write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(InputError, match=r"repository\.zip") as caught:
        ict_facekit.read_facekit(tmp_path)
    assert caught.value.code == "download.unreadable"


def test_published_texture_coordinates_are_those_of_the_corners(tmp_path: Path) -> None:
    corners = "f 1/3/1 2/1/1 3/2/1 4/4/1\nf 1/3 2/1 3/2\n"
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nvt 0 .1\nvt .2 .3 0\nvt .4 .5\nvt 1 1\n{corners}")
    (tmp_path / "b.obj").write_text("v 0 0 0\nvt 0 0\nf 1//1 2//1 3//1\n")
    with_them, without = sorted(public_files(tmp_path, ".obj"), key=lambda file: file.name)
    found = obj_texture(with_them)
    assert found is not None
    np.testing.assert_array_equal(found[0], [[0, 0.1], [0.2, 0.3], [0.4, 0.5], [1, 1]])
    np.testing.assert_array_equal(found[1], [[2, 0, 1, 3], [2, 0, 1, -1]])
    assert obj_texture(without) is None
