"""Scenes as documents: what is refused, and what is said of it."""

import jsonschema
import numpy as np
import pytest

from solver.errors import InputError
from solver.kinds.document import json_schema
from solver.kinds.scene import AnimateScene, EditScene, SimulateScene
from solver.mechanics.flesh import IDENTITY
from solver.scene.document import document_of, drives_of, read_scene
from tests.solver.block import divided_block

EVERYTHING = {
    "fps": 24,
    "duration": 1.5,
    "mode": "dynamic",
    "damping": 1,
    "material": {"law": "corotated_det", "stiffness_pa": 5000},
    "contact": {"lips": True, "friction": 0.3},
    "keys": [
        {"time": 0},
        {
            "time": 1,
            "expressions": {"smile": 1.0},
            "muscles": {"risorius": 0.8, "masseter": [1, 0, 0, 1, 0, 1]},
            "jaw": {"open_deg": 5, "left_deg": -2, "move_mm": [0, 0, 2]},
        },
    ],
    "head": [{"time": 0.5, "rotation_deg": [0, 20, 0]}],
    "performance": [
        {"asset": "take", "start": 3, "speed": 0.5, "gain": 2, "muscles": {"risorius": 0}},
        {"asset": "other", "mask": ["risorius"], "bridges": {"spans": [{"start": 1, "end": 4}]}},
    ],
    "forces": [
        {"kind": "gravity"},
        {"kind": "wind", "m_s": [10, 0, 0], "gusts": 0.3},
        {"kind": "point", "at": "pogonion", "mn": [0, 0, 500], "ramp": 1},
    ],
    "objects": [
        {"name": "glass", "mesh": {"box_mm": [120, 120, 2]}, "at": [0, 0, 60]},
        {"name": "ball", "mesh": {"ball_mm": 10}, "path": [{"time": 0, "move_mm": [0, 0, 9]}]},
        {"name": "rod", "mesh": {"rod_mm": [3, 60]}},
    ],
    "edits": [{"kind": "paralysis", "side": "left"}],
}


def test_a_stretch_of_a_whole_muscle_is_that_of_each_compartment():
    model = divided_block()
    scene = read_scene({"keys": [{"time": 0, "muscles": {"left": 0.8}}]}, SimulateScene)
    found = drives_of(scene, {}, model, model.weights)(0.0).a
    np.testing.assert_allclose(found[:2, 0], 0.8, atol=1e-9)
    np.testing.assert_array_equal(found[2:], [IDENTITY, IDENTITY])
    scene = read_scene({"keys": [{"time": 0, "muscles": {"tongue": 0.8}}]}, SimulateScene)
    with pytest.raises(InputError, match="'tongue'"):
        drives_of(scene, {}, model, model.weights)


def test_the_schema_is_one_and_defaults_are_allowed():
    for kind in (SimulateScene, AnimateScene, EditScene):
        jsonschema.Draft202012Validator.check_schema(json_schema(kind))
    jsonschema.validate(EVERYTHING, json_schema(SimulateScene))
    assert document_of(read_scene(EVERYTHING, SimulateScene)) == EVERYTHING
    read_scene({}, SimulateScene)
    read_scene({"recording": {"asset": "take", "start": 3}}, AnimateScene)
    read_scene({"edits": []}, EditScene)


@pytest.mark.parametrize(
    ("scene", "where", "words"),
    [
        ([], "scene", "is not of type 'object'"),
        ({"fps": 0}, "scene.fps", "minimum"),
        ({"speed": 3}, "scene", "speed"),
        ({"keys": [{"expressions": {}}]}, "scene.keys[0]", "'time' is a required property"),
        (
            {"keys": [{"time": 0, "expressions": {"smile": 3}}]},
            "scene.keys[0].expressions.smile",
            "3",
        ),
        ({"forces": [{"kind": "wind"}]}, "scene.forces[0]", "'m_s' is a required property"),
        ({"performance": {}}, "scene.performance", "'asset' is a required property"),
        ({"performance": "take"}, "scene.performance", "a performance or a list of them"),
        (
            {"performance": [{"asset": "take"}, {"asset": "take", "muscles": {"risorius": -1}}]},
            "scene.performance[1].muscles.risorius",
            "-1 is less than the minimum of 0",
        ),
        (
            {"performance": {"asset": "take", "bridges": {"spans": [{"start": 4}]}}},
            "scene.performance.bridges.spans[0]",
            "'end' is a required property",
        ),
        (
            {"objects": [{"name": "x", "mesh": {"box_mm": [1, 2]}}]},
            "scene.objects[0].mesh.box_mm",
            "short",
        ),
        ({"fps": float("nan")}, "scene.fps", "nan is not a number"),
        ({"head": [{"time": 0, "move_mm": [0, float("nan"), 0]}]}, "scene.head[0].move_mm[1]", "n"),
        ({"duration": float("inf")}, "scene.duration", "maximum"),
        (
            {"keys": [{"time": 0, "jaw": {"open_deg": 10**400}}]},
            "scene.keys[0].jaw.open_deg",
            "max",
        ),
        ({"edits": [{"kind": "wings"}]}, "scene.edits[0].kind", "'wings' is not one of"),
        (
            {"edits": [{"kind": "fat", "f_min": 1}]},
            "scene.edits[0]",
            "'f_max' is a required property",
        ),
    ],
)
def test_the_first_fault_is_named(scene, where, words):
    with pytest.raises(InputError, match=words) as raised:
        read_scene(scene, SimulateScene)
    assert raised.value.code == "scene.schema"
    assert raised.value.context["where"] == where


def test_whole_numbers_are_integers_however_they_are_written():
    scene = {"steps_per_frame": 2.0, "forces": [{"kind": "point", "at": 5.0, "mn": [0.5, 1.0, 0]}]}
    found = document_of(read_scene(scene, SimulateScene))
    numbers = [found["steps_per_frame"], found["forces"][0]["at"], *found["forces"][0]["mn"]]
    assert numbers == [2, 5, 0.5, 1, 0]
    assert [type(each) for each in numbers] == [int, int, float, int, int]


def test_an_animation_needs_its_recording():
    with pytest.raises(InputError, match="recording"):
        read_scene({}, AnimateScene)
