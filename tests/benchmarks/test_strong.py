"""Strong expressions by the names of both templates' shapes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.strong import (
    STRONG,
    DrawOptions,
    Expression,
    called_actions,
    draw_mixtures,
    shape_weights,
    strong_scans,
)
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
    snarl = motion["snarl"]
    x = template.skin.vertices[:, 0]
    assert snarl[x > 20.0].max() > 5.0
    assert snarl[x < -20.0].max() < 1.0


def test_drawn_mixtures_are_of_units_that_go_together() -> None:
    shapes = [
        *("mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight"),
        *("mouthShrugLower", "mouthShrugUpper", "browInnerUp", "jawLeft", "jawRight"),
    ]
    found = draw_mixtures(shapes, DrawOptions(count=40))
    assert found == draw_mixtures(shapes, DrawOptions(count=40))
    for weights in found.values():
        actions = called_actions(weights)
        codes = {action.unit.code for action in actions}
        bases = {split_side(shape)[0] for shape in weights}
        assert 2 <= len(codes) == len(bases) <= 5
        assert not codes >= {"AU 12", "AU 15"}  # smile and frown
    # some of the smiles are of one side, and call for the muscles of that one alone
    smiles = [weights for weights in found.values() if len(weights.keys() & set(shapes[:2])) == 1]
    assert smiles
    sides = {side for unit, side in called_actions(smiles[0]) if unit.code == "AU 12"}
    assert len(sides) == 1
