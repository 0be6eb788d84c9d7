"""Training: S of a template by its own expressions, and how persons come by it."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Target
from solver.fitting.recruitment import recruit
from solver.fitting.training import TrainingOptions, join_units, single_units, train_model
from solver.model import Expressions
from tests.fixtures import small_model


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
