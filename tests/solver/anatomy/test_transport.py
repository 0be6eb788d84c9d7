"""One mesh for everybody, on a ball for a head."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy import build
from solver.anatomy.build import build_subject_model, model_summary
from solver.anatomy.template import Compartments, Template
from solver.errors import InputError, SolveError
from tests.solver.ball import EDGE_MM, meshed_ball

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def template():
    return meshed_ball()


@pytest.fixture(scope="module")
def neutral(template):
    """Another person: longer, narrower, turned a little, with a dent in one cheek."""
    skin = template.skin.vertices * [0.9, 1.15, 1.0]
    dent = np.exp(-np.sum(((skin - [25.0, 0, 45]) / 12.0) ** 2, axis=1))
    skin[:, 2] -= 4.0 * dent
    turn = np.array([[0.98, 0.0, 0.2], [0.0, 1.0, 0.0], [-0.2, 0.0, 0.98]])
    return skin @ turn.T + [3.0, -10.0, 2.0]


@pytest.fixture(scope="module")
def model(template, neutral):
    return build_subject_model(template, neutral, edge_mm=EDGE_MM)


def test_the_person_has_the_templates_tets_and_muscles(template, model):
    mesh = template.mesh
    assert model.mesh_source == "transport"
    assert model.template["sha256"] == template.sha256
    for name in ("tets", "mandible", "cut", "embedded"):
        assert np.array_equal(getattr(model, name), getattr(mesh, name))
    assert np.array_equal(np.union1d(model.cranium, model.sliding), mesh.cranium)
    assert np.array_equal(model.weights.indices, mesh.weights.indices)
    assert np.array_equal(model.weights.indptr, mesh.weights.indptr)


def test_the_person_is_sound(model):
    figures = model_summary(model)
    assert figures["inverted"] == 0
    assert figures["smallest_dihedral_deg"] > 10
    assert figures["embedding_mean_mm"] < 0.15
    assert figures["surface_mean_mm"] < 0.8


def test_bone_vertices_stay_on_their_bones(model):
    """Also where the person is another shape: the mandible's ball becomes an ellipsoid."""
    centre = model.bones["mandible"].vertices.mean(axis=0)
    bone = np.linalg.norm(model.bones["mandible"].vertices - centre, axis=1)
    held = np.linalg.norm(model.rest[model.mandible] - centre, axis=1)
    assert held.min() > bone.min() - 1.5
    assert held.max() < bone.max() + 1.5


def test_the_same_person_gets_the_same_model(template, neutral, model):
    again = build_subject_model(template, neutral, edge_mm=EDGE_MM)
    assert again.sha256 == model.sha256


def test_everybody_has_the_same_compartments(template, neutral):
    halves = Compartments("lateral", ("right", "left"))
    muscle = replace(template.muscles[0], compartments=halves)
    divided = replace(template, muscles=(muscle,))
    one, other = (
        build_subject_model(divided, skin, edge_mm=EDGE_MM, compartments=True)
        for skin in (template.skin.vertices, neutral)
    )
    assert one.muscle_names == other.muscle_names == ("frontalis.right", "frontalis.left")
    assert np.array_equal(one.weights.toarray(), other.weights.toarray())
    figures = model_summary(other)
    assert figures["muscle_volume_kept"].keys() == {"frontalis"}
    right, left = figures["muscle_volume_cm3"].values()
    assert abs(np.log(right / left)) < 0.3  # of few tets
    assert build_subject_model(divided, neutral, edge_mm=EDGE_MM).muscle_names == ("frontalis",)


def test_a_person_who_can_not_be_reached_is_meshed_anew(template, neutral, monkeypatch):
    def fail(*_):
        raise SolveError("mesh.inverted", "3 tetrahedra stay inverted")

    monkeypatch.setattr(build, "transport", fail)
    model = build_subject_model(template, neutral, edge_mm=EDGE_MM)
    assert "3 tetrahedra stay inverted" in model.mesh_source
    assert model_summary(model)["inverted"] == 0


def test_the_mesh_survives_the_templates_file(template, neutral, model, tmp_path):
    digest = template.save(tmp_path / "ball.npz")
    found = Template.load(tmp_path / "ball.npz")
    assert found.sha256 == digest == template.sha256
    assert build_subject_model(found, neutral, edge_mm=EDGE_MM).sha256 == model.sha256
    assert replace(found, mesh=None).sha256 != digest


def test_a_template_whose_arrays_do_not_fit_is_refused(template, tmp_path):
    count = len(template.skin.vertices)
    mesh = replace(template.mesh, tets=template.mesh.tets + 1)
    holes = template.parting.copy()
    holes[7, 1] = np.nan
    wrong = {
        "template.range": [
            replace(template, mesh=mesh),
            replace(template, face_vertices=np.array([3, count])),
            replace(template, landmarks={"nose": -1}),
        ],
        "template.shape": [
            replace(template, condyles=template.condyles[:1]),
            replace(template, parting=template.parting[:-1]),
        ],
        "template.nan": [replace(template, parting=holes)],
    }
    path = tmp_path / "mine.npz"
    for code, templates in wrong.items():
        for broken in templates:
            broken.save(path)
            with pytest.raises(InputError, match=r"mine\.npz") as caught:
                Template.load(path)
            assert caught.value.code == code
