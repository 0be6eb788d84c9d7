"""What a scene makes of a person: every part of its document reaches the simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.kinds.scene import SimulateScene
from solver.model import SubjectModel
from solver.scene import Stage
from solver.scene.document import drives_of, read_scene
from solver.scene.places import Places
from solver.surface import Floats
from tests.solver.block import head_block

MODEL = head_block((7, 5, 1))
PULL = {"kind": "point", "at": [75, 60, 45], "mn": [0, 0, 40], "radius_mm": 40}
BALL = {"name": "ball", "mesh": {"ball_mm": 5}}


def staged(scene: dict[str, Any], model: SubjectModel = MODEL) -> Stage:
    played = read_scene(scene, SimulateScene)
    drives = drives_of(played, {}, model, model.weights)
    return Stage(played, Places(model, {}), model.weights, drives)


def pulled(**scene: Any) -> Floats:
    """Return how far a pull takes the block's vertices in a dynamic step from rest."""
    quiet = staged({"mode": "dynamic", **scene})
    stage = staged({"mode": "dynamic", "forces": [PULL], **scene})
    first, last = (stage.drive(time, stage.drives(time)) for time in (0.0, 0.02))
    stepped = stage.simulator.step(quiet.simulator.rest(first), first, last)
    return np.asarray(stepped.y - MODEL.rest)


def furthest(moved: Floats) -> float:
    return float(np.linalg.norm(moved, axis=1).max())


def test_inertia_and_damping_hold_flesh_back() -> None:
    usual = furthest(pulled(damping=0))
    heavy = {"kind": "density", "factor": 20}
    assert 1e-3 < furthest(pulled(damping=0, edits=[heavy])) < 0.5 * usual
    assert 1e-3 < furthest(pulled(damping=1000)) < 0.5 * usual


def test_objects_are_in_the_world_and_the_head_moves_in_it() -> None:
    moved = [{"time": 0, "move_mm": [0, 0, 50]}]
    staged({"objects": [{**BALL, "at": [75, 60, 95]}]})
    with pytest.raises(InputError) as caught:
        staged({"objects": [{**BALL, "at": [75, 60, 95]}], "head": moved})
    assert caught.value.code == "scene.object_inside"
    stage = staged({"objects": [{**BALL, "at": [75, 60, 110]}], "head": moved})
    drive = stage.drive(0.0, stage.drives(0.0))
    assert stage.penetration(MODEL.rest, drive).objects == 0.0


def test_eyes_turn_with_the_gaze() -> None:
    ids = np.arange(0, len(MODEL.skin.vertices), 7)
    stage = staged({}, replace(MODEL, regions={"left_eyeball": ids}))
    away = np.array([[0.0, 0.3, 0.0], [0.0, 0.0, 0.0]])
    straight, turned = (stage.skin(MODEL.rest, np.zeros(5), eyes, 0.0) for eyes in (0 * away, away))
    changed = np.linalg.norm(turned - straight, axis=1) > 1e-6
    assert changed[ids].any()
    assert not np.delete(changed, ids).any()
