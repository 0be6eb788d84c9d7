"""From a ball for a head to a model: everything build_subject_model promises, without any data."""

import numpy as np
import pytest

from solver.anatomy.build import build_subject_model, jaw_tracks, model_summary
from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.mechanics.jaw_tracks import JawTracks
from solver.model import SubjectModel
from tests.solver.ball import ball_template

pytestmark = pytest.mark.long

LOWER = np.array([0.0, -20.0, 2.0])


@pytest.fixture(scope="module")
def template():
    return ball_template()


@pytest.fixture(scope="module")
def model(template):
    # Lower than the template: the face reaches below the template's cut plane.
    neutral = template.skin.vertices * [1.1, 1.0, 1.05] + LOWER
    return build_subject_model(template, neutral, edge_mm=18.0)


def test_every_tet_is_positive_and_every_vertex_used(model):
    assert volumes(model.rest, model.tets).min() > 0
    assert np.array_equal(np.unique(model.tets), np.arange(len(model.rest)))


def test_bones_hold_different_vertices(model):
    held = [model.cranium, model.mandible, model.cut, model.sliding]
    assert all(len(numbers) for numbers in held)
    everything = np.concatenate(held)
    assert len(np.unique(everything)) == len(everything)
    assert not np.isin(model.tets, everything).all(axis=1).any()
    both = np.isin(model.tets, np.concatenate([model.cranium, model.sliding])).any(axis=1)
    assert not (both & np.isin(model.tets, model.mandible).any(axis=1)).any()


def test_mandible_vertices_lie_on_the_carried_mandible(model):
    centre = model.bones["mandible"].vertices.mean(axis=0)
    distance = np.linalg.norm((model.rest[model.mandible] - centre) / [1.1, 1.0, 1.05], axis=1)
    assert np.abs(distance - 10).max() < 1.5


def test_skin_follows_the_flesh(model, template):
    assert np.isin(template.face_vertices, model.embedded).all()
    follows = model.embedding @ model.rest + model.offset
    assert np.allclose(follows, model.skin.vertices[model.embedded])
    assert np.allclose(model.embedding.sum(axis=1), 1)
    assert model_summary(model)["embedding_max_mm"] < 2


def test_jaw_axis_goes_from_right_to_left_condyle(model):
    assert np.allclose(model.jaw.axes @ model.jaw.axes.T, np.eye(3))
    assert np.linalg.det(model.jaw.axes) == pytest.approx(1)
    assert model.jaw.axes[0, 0] > 0.99
    assert np.allclose(model.jaw.origin, np.array([0, 0.5, 0]) + LOWER, atol=0.5)


def test_the_jaw_has_the_templates_tracks(model, template):
    assert JawTracks.of(model.jaw) == jaw_tracks(template, model)


def test_muscle_volume_is_kept(model):
    assert model_summary(model)["muscle_volume_kept"]["frontalis"] > 0.8


def test_model_survives_its_file(model, tmp_path):
    model.save(tmp_path / "model.npz")
    again = SubjectModel.load(tmp_path / "model.npz")
    assert np.array_equal(again.tets, model.tets)
    assert again.weights.nnz == model.weights.nnz


def test_wrong_scans_are_named(template):
    with pytest.raises(InputError) as caught:
        build_subject_model(template, template.skin.vertices[:-1])
    assert caught.value.code == "scan.vertex_count"
    broken = template.skin.vertices.copy()
    broken[7, 1] = np.nan
    with pytest.raises(InputError) as caught:
        build_subject_model(template, broken)
    assert caught.value.context["vertex"] == 7
