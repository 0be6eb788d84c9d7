"""A template as a folder: written, changed by hand, read back."""

from __future__ import annotations

import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.anatomy.template import Compartments, Depth, Muscle, ShapeBasis, Template
from solver.errors import InputError
from solver.meshio.obj import write_obj
from solver.surface import Floats, Surface
from solver.templates.folder import read_template
from solver.templates.tables import write_template


def sphere(centre: tuple[float, float, float], radius: float) -> Surface:
    """Return an octahedron, split once."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    return Surface(np.array(centre) + radius * corners, faces)


@pytest.fixture
def template() -> Template:
    skin = sphere((0, 0, 0), 100.0)
    eye = sphere((20, 20, 60), 5.0)
    both = Surface(np.vstack([skin.vertices, eye.vertices]), np.vstack([skin.faces, eye.faces + 6]))
    rng = np.random.default_rng(0)
    left = Muscle(
        "left smiler",
        sphere((30, 0, 40), 8.0),
        np.array([0.6, 0.0, 0.8]),
        np.array([30.0, 0.0, 32.0]),
        np.array([30.1, 0.0, 48.0]),
        compartments=Compartments.read("lateral | superior", "inner; outer | lower; upper"),
    )
    return Template(
        name="ball",
        version="2",
        source='by hand, "for tests"',
        licence="CC0 1.0",
        skin=both,
        flesh_faces=np.arange(8),
        face_vertices=np.array([0, 2, 4]),
        attached_cranium=np.arange(6, 12),
        attached_mandible=np.array([3]),
        parting=rng.normal(size=(12, 3)),
        cranium=sphere((0, 30, 0), 40.0),
        mandible=sphere((0, -40, 0), 30.0),
        muscles=(left, replace(left, name="ring of the eye", ring=True)),
        condyles=np.array([[50.0, 0.1, 20.0], [-50.0, 0.1, 20.0]]),
        back_z=-20.5,
        bottom_y=-80.0,
        landmarks={"chin": 3, "tip": 4},
        regions={"upper": np.array([0, 2]), "lower": np.array([3])},
        shapes=ShapeBasis(
            rng.normal(size=(2, 12, 3)).astype(np.float32),
            rng.normal(size=(1, 12, 3)).astype(np.float32),
            ("jawOpen",),
        ),
        depths=(Depth("chin", "mandible", 11.0, 2.5, "somebody 2008"),),
    )


@pytest.fixture
def folder(template: Template, tmp_path: Path) -> Path:
    write_template(template, tmp_path / "ball")
    return tmp_path / "ball"


def assert_equal(found: Template, expected: Template) -> None:
    one = found._archive()
    other = expected._archive()
    assert one.header == other.header
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        assert np.allclose(array, other.arrays[name], atol=1e-6), name


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_what_was_written_is_read_back(folder: Path, template: Template) -> None:
    assert_equal(read_template(folder), template)


def test_zip_of_the_folder_is_the_same(folder: Path, template: Template, tmp_path: Path) -> None:
    shutil.make_archive(str(tmp_path / "sent"), "zip", tmp_path, "ball")
    assert_equal(read_template(tmp_path / "sent.zip"), template)


def test_what_the_reader_made_is_a_file_like_any(folder: Path, tmp_path: Path) -> None:
    read = read_template(folder)
    assert read.save(tmp_path / "ball.npz") == read.sha256
    assert Template.load(tmp_path / "ball.npz").sha256 == read.sha256


def test_unit_and_axes_of_the_whole_folder(folder: Path, template: Template) -> None:
    """The same anatomy in metres with z up and -y forward, as a modelling tool would write it."""

    def turned(points: Floats) -> Floats:
        return np.column_stack([points[:, 0], -points[:, 2], points[:, 1]]) / 1000.0

    for path in [*folder.glob("*.ply"), *folder.glob("*/*.ply")]:
        path.unlink()
    skin = template.skin
    write_obj(folder / "skin.obj", skin.with_vertices(turned(skin.vertices)))
    write_obj(folder / "parted.obj", skin.with_vertices(turned(skin.vertices + template.parting)))
    for name in ("cranium", "mandible"):
        bone: Surface = getattr(template, name)
        write_obj(folder / f"{name}.obj", bone.with_vertices(turned(bone.vertices)))
    rows = ["name,file,ring,origin_x,origin_y,origin_z,insertion_x,insertion_y,insertion_z"]
    for muscle in template.muscles:
        file = muscle.name.replace(" ", "-") + ".obj"
        write_obj(folder / file, muscle.surface.with_vertices(turned(muscle.surface.vertices)))
        ends = turned(np.stack([muscle.origin, muscle.insertion])).ravel().tolist()
        ring = "yes" if muscle.ring else ""
        rows.append(",".join([muscle.name, file, ring, *map(repr, ends)]))
    (folder / "muscles.csv").write_text("\ufeff" + "\r\n".join(rows) + "\r\n")
    toml = folder / "template.toml"
    change(toml, 'unit = "mm"\nup = "y"\nforward = "z"', 'unit = "m"\nup = "z"\nforward = "-y"')
    change(toml, "[50.0, 0.1, 20.0]", "[0.05, -0.02, 0.0001]")
    change(toml, "[-50.0, 0.1, 20.0]", "[-0.05, -0.02, 0.0001]")
    change(toml, "back = -20.5", "back = -0.0205")
    change(toml, "bottom = -80.0", "bottom = -0.08")
    along = (template.muscles[0].insertion - template.muscles[0].origin) / np.linalg.norm(
        template.muscles[0].insertion - template.muscles[0].origin
    )
    expected = replace(
        template,
        shapes=None,
        muscles=tuple(
            replace(muscle, fibre=along) for muscle in template.without_compartments.muscles
        ),
    )
    found = read_template(folder)
    assert np.abs(found.parting - template.parting).max() < 2e-3  # OBJ has six decimals of a metre
    assert np.abs(found.skin.vertices - skin.vertices).max() < 1e-3
    assert_equal(
        replace(
            found,
            skin=skin,
            parting=template.parting,
            cranium=template.cranium,
            mandible=template.mandible,
        ),
        expected,
    )


def test_lips_are_parted_by_expressions(folder: Path, template: Template) -> None:
    (folder / "parted.ply").unlink()
    with (folder / "template.toml").open("a") as stream:
        stream.write("[parting]\njawOpen = 0.5\n")
    assert template.shapes is not None
    expected = 0.5 * template.shapes.expressions[0]
    assert np.allclose(read_template(folder).parting, expected, atol=1e-6)


def test_muscle_without_attachments_gets_those_of_its_shape(folder: Path) -> None:
    (folder / "muscles.csv").write_text("name,file\nsmiler,muscles/left_smiler.ply\n")
    (muscle,) = read_template(folder).muscles
    assert np.linalg.norm(muscle.fibre) == pytest.approx(1.0)


FAULTS = [
    ("template.toml", 'name = "ball"', "", "template.value", "name is missing"),
    ("template.toml", 'name = "ball"', 'name = "ba', "template.unreadable", "line 2"),
    ("template.toml", "format = 1", "format = 9", "template.value", "format is 9"),
    ("template.toml", 'unit = "mm"', 'unit = "ell"', "template.frame", "mm, cm, m, inch"),
    ("template.toml", 'forward = "z"', 'forward = "y"', "template.frame", "along one axis"),
    ("template.toml", "back = -20.5", "", "template.value", r"\[planes\] back"),
    ("template.toml", "left = [50.0, ", "left = [", "template.value", r"\[condyles\] left"),
    ("landmarks.csv", "chin,3", "chin,30", "template.vertex", "vertex 30 is none of the skin's 12"),
    ("landmarks.csv", "tip,4", "tip,four", "template.table", r"landmarks\.csv, line 3"),
    ("landmarks.csv", "tip,4", "tip,\u00b2", "template.table", r"landmarks\.csv, line 3"),
    ("landmarks.csv", "tip,4", "chin,4", "template.table", "another landmark chin"),
    ("muscles.csv", "name,file", "nom,file", "template.table", "lacks the columns name"),
    ("muscles.csv", ",30.0,0.0,32.0,", ",30.0,0.0,thirty,", "template.table", "line 2: origin_z"),
    ("muscles.csv", ",30.0,0.0,32.0,", ",,,,", "template.table", "given together"),
    ("muscles.csv", ",no,", ",maybe,", "template.table", "neither yes nor no"),
    ("muscles.csv", "lateral", "upwards", "template.table", "line 2: cut is none of sectors"),
    ("muscles.csv", "left_smiler.ply", "gone.ply", "template.missing", r"gone\.ply"),
    ("muscles.csv", "muscles/", "../muscles/", "template.table", "outside the folder"),
    ("parts.json", '"6-11"', '"6-12"', "template.vertex", "vertex 12 is none"),
    ("parts.json", '"6-11"', '"6-99999999999"', "template.vertex", "vertex 12 is none"),
    ("parts.json", '"face": [', '"face": [], "other": [', "template.shape", "face_vertices is"),
    ("parts.json", '"with_mandible"', '"jaw"', "template.value", "lacks with_mandible"),
    ("regions.json", '"upper": [0', '"upper": ["x"', "template.vertex", "like '10-20'"),
    ("regions.json", "}", "", "template.unreadable", r"regions\.json"),
    ("depths.csv", "mandible", "jaw", "template.table", "cranium and mandible"),
    ("depths.csv", "somebody 2008", "", "template.table", "source is empty"),
]


@pytest.mark.parametrize(("file", "old", "new", "code", "message"), FAULTS)
def test_fault_names_file_and_place(
    file: str, old: str, new: str, code: str, message: str, folder: Path
) -> None:
    change(folder / file, old, new)
    with pytest.raises(InputError, match=message) as caught:
        read_template(folder)
    assert caught.value.code == code


@pytest.mark.parametrize("name", ["skin.ply", "cranium.ply", "muscles.csv", "regions.json"])
def test_missing_file_is_named(name: str, folder: Path) -> None:
    (folder / name).unlink()
    with pytest.raises(InputError, match=re.escape(name)) as caught:
        read_template(folder)
    assert caught.value.code == "template.missing"


def test_shape_of_another_topology_is_named(folder: Path, template: Template) -> None:
    write_obj(folder / "expressions" / "smile.obj", template.cranium)
    with pytest.raises(InputError, match=r"smile\.obj has 6 vertices, the skin has 12") as caught:
        read_template(folder)
    assert caught.value.code == "template.mesh"


def test_vertex_that_is_no_number_is_named(folder: Path, template: Template) -> None:
    (folder / "skin.ply").unlink()
    vertices = template.skin.vertices.copy()
    vertices[7, 1] = np.nan
    write_obj(folder / "skin.obj", template.skin.with_vertices(vertices))
    with pytest.raises(InputError, match="vertex 7") as caught:
        read_template(folder)
    assert caught.value.context["file"] == "skin.obj"


def test_what_is_no_template_is_named(tmp_path: Path) -> None:
    (tmp_path / "photo.zip").write_bytes(b"\xff\xd8")
    with pytest.raises(InputError, match=r"photo\.zip is neither"):
        read_template(tmp_path / "photo.zip")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "")
    with pytest.raises(InputError, match=r"no template\.toml"):
        read_template(tmp_path / "other.zip")


def test_nothing_is_overwritten(folder: Path, template: Template) -> None:
    with pytest.raises(InputError, match="not empty"):
        write_template(template, folder)


def test_a_description_without_an_end_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "template.toml").write_text("a" + ".a" * 4_000_000 + " = 1")
    with pytest.raises(InputError, match="at most 32768") as caught:
        read_template(tmp_path)
    assert caught.value.code == "template.too_large"
