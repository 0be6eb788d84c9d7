"""Strong expressions by the names of both templates' shapes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.strong import STRONG, Expression, shape_weights, strong_scans
from solver.anatomy.template import split_side
from solver.errors import InputError
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_facekit import read_facekit, shape_basis
from tests.fixtures import data_folder

SHAPES = ["jawOpen", "browInnerUpLeft", "browInnerUpRight", "jawLeft"]


def test_a_weight_goes_to_the_sides_that_move() -> None:
    both = Expression({"browInnerUp": 0.5, "jawOpen": 0.2})
    assert shape_weights(both, SHAPES) == {
        "browInnerUpLeft": 0.5,
        "browInnerUpRight": 0.5,
        "jawOpen": 0.2,
    }
    left = Expression({"browInnerUp": 0.5}, sides=("left",))
    assert shape_weights(left, SHAPES) == {"browInnerUpLeft": 0.5}
    with pytest.raises(InputError, match="mouthSmile") as refused:
        shape_weights(STRONG["laugh"], SHAPES)
    assert refused.value.code == "captures.expression"


def test_ict_facekit_has_the_shapes() -> None:
    names = shape_basis(read_facekit(data_folder("ict_facekit"))).expression_names
    for expression in STRONG.values():
        found = shape_weights(expression, names)
        assert {split_side(name)[0] for name in found} == expression.weights.keys()
    assert all(name.endswith("Left") for name in shape_weights(STRONG["snarl"], names))


def test_the_built_in_person_makes_them() -> None:
    template = builtin_template()
    made = strong_scans(template, template.skin)
    assert list(made) == list(STRONG)
    motion = {
        name: np.linalg.norm(scan.vertices - template.skin.vertices, axis=1)
        for name, scan in made.items()
    }
    assert min(each.max() for each in motion.values()) > 5.0
    snarl, x = motion["snarl"], template.skin.vertices[:, 0]
    assert snarl[x > 20.0].max() > 5.0
    assert snarl[x < -20.0].max() < 1.0
