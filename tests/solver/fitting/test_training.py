"""Training: S of a template by its own expressions, and how persons come by it."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.activation import unseen_regulariser
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Target, distances
from solver.fitting.simplex import mix_by_stiffness
from solver.fitting.training import TrainingOptions, join_units, single_units, train_model
from solver.model import Expressions
from tests.fixtures import small_model

CORNERS = ((33.0, -30.0, 95.0), (-33.0, -30.0, 95.0))  # of the mouth, mm


def expressions(*names, motions=None):
    motions = np.ones((len(names), 4, 3)) if motions is None else motions
    return Expressions(names, np.asarray(motions, dtype=np.float32))


def test_units_are_learned_on_both_sides_and_only_where_muscles_make_them():
    found = single_units(
        expressions("mouthSmileLeft", "mouthSmileRight", "jawLeft", "cheekPuff", "eyeLookUpLeft")
    )
    assert list(found) == ["mouthSmile", "jawLeft"]
    np.testing.assert_array_equal(found["mouthSmile"], 2.0)
    np.testing.assert_array_equal(found["jawLeft"], 1.0)


def test_units_that_move_other_places_are_joined():
    place = np.eye(4)[:, :, None] * np.array([1.0, 0.0, 0.0])
    units = {"low": 3.0 * place[0], "beside": place[0] + 0.1 * place[1], "high": 2.0 * place[3]}
    assert join_units(units, 0.1) == [("low", "high"), ("beside",)]
    assert join_units(units, 0.0) == [("low",), ("high",), ("beside",)]


@pytest.mark.long
def test_muscles_of_a_unit_learn_to_make_its_skin():
    """A smile of 4 mm, which S by anatomy alone cannot make with the zygomatic muscles."""
    model = small_model()
    rest = model.skin.vertices[model.face]
    corners = [np.argmin(np.linalg.norm(rest - place, axis=1)) for place in CORNERS]
    nearness = np.exp(-np.sum((rest - rest[corners][:, None]) ** 2, axis=2) / 450.0)
    smiles = 4.0 * nearness[:, :, None] * np.array([[[0.5, 0.6, -0.4]], [[-0.5, 0.6, -0.4]]])
    names = ("mouthSmileLeft", "mouthSmileRight")
    model = replace(model, expressions=expressions(*names, motions=smiles))
    target = Target.from_points(rest + smiles.sum(axis=0))
    options = TrainingOptions(schedule=GeometryOptions(rounds=3, within=Admissible()))
    trained = train_model(model, options)
    by_anatomy = mix_by_stiffness(model.weights, 30.0)
    found = {}
    for S in (by_anatomy, trained):
        face = Face(model, S).driven_as(Admissible())
        prior = unseen_regulariser(face, target)
        state = activation.fit(face, distances(face, {"smile": target})["smile"], prior).state
        contraction = Contraction.of_face(face)(state.pose.a)
        pulling = contraction[model.muscle_numbers("zygomaticus_major_l")].max()
        found[S is trained] = target.distances(face.face_points(state.x)).mean(), pulling
    assert found[True][0] < 0.8 * found[False][0]
    assert found[True][1] > found[False][1] > 0.0


def test_a_template_without_units_has_nothing_to_learn():
    with pytest.raises(InputError, match="no expression of one unit") as caught:
        train_model(replace(small_model(), expressions=expressions("eyeLookUpLeft")))
    assert caught.value.code == "template.no_units"
