"""Units that no expression shows: whose they are, and that flesh makes them so."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.action_units import find_called
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Target
from solver.fitting.predicted_units import PredictionOptions, predict_units, unshown_units
from solver.fitting.recruitment import Recruitment
from solver.fitting.stretches import fibre_tensors, isochoric_activation
from solver.model import Expressions
from tests.fixtures import small_model

FROWN = "AU15Left"


@pytest.fixture(scope="module")
def face():
    """A face whose template shows no more than a smile: a bump at the corner of the mouth."""
    model = small_model()
    points = model.skin.vertices[model.face]
    corner = model.skin.vertices[model.region("upper_lip")]
    there = corner[np.argmax(corner[:, 0])]
    bump = 6.0 * np.exp(-np.sum((points - there) ** 2, axis=1) / 200.0)
    motion = (bump[:, None] * [0.5, 0.7, -0.5]).astype(np.float32)
    return Face(replace(model, expressions=Expressions(("mouthSmileLeft",), motion[None])))


def skin_of(face, name, stretch):
    """Return the skin as the muscles of a unit contract by the geometric S."""
    model = face.model
    tensors = fibre_tensors(model, face.flesh.volumes, model.weights)
    a = face.rest_pose().a
    for muscle in np.flatnonzero(find_called(model.muscle_names, name)[0]):
        a[muscle] = isochoric_activation(tensors[muscle], stretch)
    pose = Pose(a, face.rest_pose().b)
    return face.face_points(face.continuation(face.rest, pose).x)


def motion_of(predicted, name):
    return predicted.motions[predicted.names.index(name)].astype(np.float64)


def test_units_are_predicted_that_no_expression_shows_and_muscles_make(face):
    codes = [unit.code for unit in unshown_units(face.model)]
    assert "AU 15" in codes
    # shown, made by relaxing, by no muscle, and by those of AU 8
    assert not {"AU 12", "AU 25", "AD 34", "AU 23"} & set(codes)
    names = predict_units(face).names
    assert {FROWN, "AU15Right"} <= set(names)
    # what opens the jaw has no tets
    assert not any(name.startswith("AU27") for name in names)


def test_a_predicted_motion_is_the_way_that_flesh_takes(face):
    motion = motion_of(predict_units(face), FROWN)
    size = np.linalg.norm(motion, axis=1)
    assert size.max() == pytest.approx(PredictionOptions.full_mm, rel=1e-4)
    step = 1e-3
    way = (skin_of(face, FROWN, 1.0 - step) - skin_of(face, FROWN, 1.0 + step)) / (2.0 * step)
    assert np.abs(way).max() > 0.1
    cosine = np.sum(way * motion) / (np.linalg.norm(way) * np.linalg.norm(motion))
    assert cosine > 0.999


def test_a_unit_that_no_expression_shows_is_called_for_where_its_muscles_pulled(face):
    pulled = Target.from_points(skin_of(face, FROWN, 0.7))
    recruitment = Recruitment.of_face(face)
    named = find_called(face.model.muscle_names, FROWN)[0]
    assert recruitment.of_target(pulled).contraction[named].min() > 0.01
    never = replace(recruitment.options, hurdle=1.0)
    shown_alone = replace(recruitment, options=never).of_target(pulled)
    np.testing.assert_array_equal(shown_alone.contraction[named], 0.0)


def test_what_expressions_explain_calls_for_nothing_else(face):
    model = face.model
    rest = model.skin.vertices[model.face]
    recruitment = Recruitment.of_face(face)
    amounts, explained = recruitment.amounts(
        Target.from_points(rest + 0.6 * model.expressions.motions[0])
    )
    assert amounts[0] == pytest.approx(0.6, abs=1e-3)
    assert explained == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(amounts[1:], 0.0, atol=1e-4)
