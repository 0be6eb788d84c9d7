"""The built-in face, built from the real files: slow only when the cache is empty."""

import igl
import numpy as np
import pytest
import trimesh

from solver.anatomy.embedding import barycentric
from solver.anatomy.meshing import EDGE_MM
from solver.anatomy.muscle_weights import initial_weights
from solver.anatomy.template import Template
from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.templates.builtin import build
from solver.templates.builtin.build import read_muscles
from solver.templates.builtin.skull import OuterSkin


@pytest.fixture(scope="module")
def template():
    try:
        return build.builtin_template()
    except InputError as error:
        if error.code == "builtin.fetch":
            pytest.skip(f"the package index cannot be reached: {error.message}")
        raise


@pytest.fixture(scope="module")
def skin():
    return OuterSkin(build.builtin_head())


def mesh(surface):
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


def neck_capped(template):
    """The flesh's outer surface with a lid on the neck."""
    faces = template.skin.faces[template.flesh_faces]
    rim = igl.boundary_loop(faces)
    centre = template.skin.vertices[rim].mean(axis=0)
    lid = np.stack([np.roll(rim, -1), rim, np.full(len(rim), len(template.skin.vertices))], axis=1)
    return np.vstack([template.skin.vertices, centre]), np.vstack([faces, lid])


def test_head_has_the_measures_of_an_adult(template):
    at = {name: template.skin.vertices[vertex] for name, vertex in template.landmarks.items()}
    assert 215 < at["vertex"][1] - at["menton"][1] < 240
    assert 128 < at["zygion_l"][0] - at["zygion_r"][0] < 142
    assert 55 < np.ptp([at["exocanthion_l"][0], at["endocanthion_r"][0]]) < 72
    assert 42 < at["cheilion_l"][0] - at["cheilion_r"][0] < 58


def test_flesh_surface_closes_mouth_and_eye_sockets(template):
    vertices, faces = neck_capped(template)
    assert mesh(template.skin.__class__(vertices, faces)).is_watertight
    at = {name: template.skin.vertices[vertex] for name, vertex in template.landmarks.items()}
    eyes = (at["exocanthion_l"] + at["endocanthion_l"]) / 2 - [0, 0, 14]
    mouth = at["stomion_superius"] - [0, -5, 40]
    flesh = [
        at["pogonion"] - [0, 0, 4],
        at["cheek_center_l"] - [0, 0, 5],
        at["glabella"] - [0, 0, 3],
    ]
    winding = igl.fast_winding_number(vertices, faces, np.array([*flesh, mouth, eyes]))
    np.testing.assert_allclose(winding, [1, 1, 1, 0, 0], atol=0.05)


@pytest.mark.long
def test_bones_are_closed_apart_and_under_the_skin(template, skin):
    for bone in (template.cranium, template.mandible):
        assert mesh(bone).is_watertight
        assert mesh(bone).volume > 0
        assert mesh(bone).body_count == 1
        assert skin.depth(bone.vertices)[0].min() >= 1.8
    squared, _, _ = igl.point_mesh_squared_distance(
        template.mandible.vertices, template.cranium.vertices, template.cranium.faces
    )
    assert np.sqrt(squared.min()) >= 1.5


@pytest.mark.long
def test_bones_lie_at_the_published_depths(template, skin):
    for landmark, bone, depth in [
        ("glabella", template.cranium, 5.5),
        ("frontal_eminence_l", template.cranium, 5),
        ("zygion_r", template.cranium, 7),
        ("pogonion", template.mandible, 11),
        ("menton", template.mandible, 7),
    ]:
        point = template.skin.vertices[[template.landmarks[landmark]]]
        squared, _, _ = igl.point_mesh_squared_distance(point, bone.vertices, bone.faces)
        assert abs(np.sqrt(squared[0]) - depth) < 2, landmark


@pytest.mark.long
def test_muscles_are_closed_and_between_skin_and_bone(template, skin):
    assert len(template.muscles) >= 43
    under_arch = {row.name for row in read_muscles() if row.layer == "under_arch"}
    for muscle in template.muscles:
        surface = muscle.surface
        assert mesh(surface).is_watertight, muscle.name
        assert mesh(surface).volume > 30, muscle.name
        assert skin.depth(surface.vertices)[0].min() > 0.2, muscle.name
        if muscle.name.removesuffix("_l").removesuffix("_r") not in under_arch:
            for bone in (template.cranium, template.mandible):
                inside = igl.fast_winding_number(bone.vertices, bone.faces, surface.vertices) > 0.5
                assert inside.mean() < 0.02, muscle.name


def test_muscles_pull_the_way_they_do(template):
    fibre = {muscle.name: muscle.fibre for muscle in template.muscles}
    along = {
        "frontalis_l": [0, -1, 0],
        "zygomaticus_major_l": [-0.5, -0.8, 0.3],
        "zygomaticus_major_r": [0.5, -0.8, 0.3],
        "depressor_anguli_oris_l": [0, 1, 0],
        "corrugator_l": [1, 0, 0],
        "masseter_superficial_l": [0, -0.9, -0.4],
        "temporalis_r": [0, -1, 0],
    }
    for name, direction in along.items():
        cosine = fibre[name] @ direction / np.linalg.norm(direction)
        assert cosine > 0.8, name


def test_expressions_leave_the_skull_and_move_the_jaw():
    head = build.builtin_head()
    assert len(head.expression_names) == 52
    opened = build.builtin_expression({"jawOpen": 1.0}).vertices - head.neutral
    assert np.abs(opened[head.part_vertices["upper_teeth"]]).max() == 0
    assert opened[head.landmarks["menton"], 1] < -20
    lower = head.part_vertices["lower_teeth"]
    hinge = np.linalg.norm(opened[lower], axis=1)
    assert hinge.min() > 10
    half = build.builtin_expression({"jawOpen": 0.5, "browInnerUp": 1.0}).vertices - head.neutral
    np.testing.assert_allclose(half[lower], opened[lower] / 2, atol=1e-9)
    with pytest.raises(InputError, match="smirk"):
        build.builtin_expression({"smirk": 1.0})


def test_demo_person_is_somebody_else_with_the_same_topology(template):
    scans = build.builtin_capture_set()
    assert len(scans.train) == 5
    assert len(scans.test) == 3
    faces = [scan.faces for scan in (scans.neutral, *scans.train.values(), *scans.test.values())]
    assert all(np.array_equal(each, template.skin.faces) for each in faces)
    other = scans.neutral.vertices - template.skin.vertices
    assert 1 < np.linalg.norm(other, axis=1)[template.face_vertices].mean() < 6


def test_face_is_brow_to_chin_without_ears(template):
    face = template.skin.vertices[template.face_vertices]
    ear = template.skin.vertices[template.landmarks["tragus_l"]]
    assert face[:, 2].min() > ear[2] + 5
    assert 1500 < len(face) < 2600
    parts = ["forehead", "brows", "nose", "eyes", "upper_lip", "lower_lip", "chin", "jaw", "cheeks"]
    named = np.concatenate([template.regions[name] for name in parts])
    assert len(np.unique(named)) == len(named)
    assert np.isin(named, template.face_vertices).all()
    assert len(named) > 0.98 * len(face)


def test_other_people_lie_within_the_shapes(template):
    """Random persons are made of one-sided shape targets, the basis of half their difference."""
    shapes = template.shapes
    skin = template.skin.vertices
    persons = [
        build.builtin_expression({}, build.random_identity(seed)).vertices - skin for seed in (1, 2)
    ]
    face = template.face_vertices
    centred = [person[face] - person[face].mean(axis=0) for person in persons]
    basis = shapes.identity[:, face] - shapes.identity[:, face].mean(axis=1, keepdims=True)
    columns = basis.reshape(len(basis), -1).T
    for person in centred:
        strength = np.linalg.lstsq(columns, person.ravel(), rcond=1e-6)[0]
        left = person.ravel() - columns @ strength
        assert np.linalg.norm(left) < 0.4 * np.linalg.norm(person)
    number = shapes.expression_names.index("jawOpen")
    opened = build.builtin_expression({"jawOpen": 1.0}).vertices - skin
    np.testing.assert_allclose(shapes.expressions[number], opened, atol=1e-4)


def test_template_survives_the_cache(template, tmp_path):
    template.save(tmp_path / "template.npz")
    again = Template.load(tmp_path / "template.npz")
    np.testing.assert_array_equal(again.parting, template.parting)
    np.testing.assert_array_equal(again.shapes.identity, template.shapes.identity)
    assert [muscle.name for muscle in again.muscles] == [m.name for m in template.muscles]


@pytest.mark.long
def test_shipped_tets_are_the_templates(template):
    """After a change of skin, bones or muscles: scripts/builtin_tets.py writes them anew."""
    mesh = template.mesh
    assert mesh.edge_mm == EDGE_MM
    assert volumes(mesh.vertices, mesh.tets).min() > 0
    muscles = [muscle.surface for muscle in template.muscles]
    difference = mesh.weights - initial_weights(mesh.vertices, mesh.tets, muscles)
    assert np.abs(difference).sum() < 1e-3 * len(mesh.tets)
    bones = {"cranium": template.cranium, "mandible": template.mandible}
    away = {
        name: barycentric(mesh.vertices[getattr(mesh, name)], bone)[2]
        for name, bone in bones.items()
    }
    away["skin"] = np.linalg.norm(
        mesh.surface_rows @ mesh.vertices - template.skin.vertices[mesh.embedded], axis=1
    )
    assert max(distance.mean() for distance in away.values()) < 0.2, away
