"""Scenes in which a neck carries the head: what of a document reaches it, and what it leaves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from solver.errors import InputError
from solver.jobs import run_job
from solver.kinds.scene import SimulateScene
from solver.kinds.scene_neck import NeckEntry
from solver.neck.anatomy import BODIES
from solver.progress import Step
from solver.rig import Rig
from solver.rig.frames.read_back import LIMIT_MM, read_glb, split_glb, validate_glb
from solver.scene import Stage
from solver.scene.document import drives_of, read_scene
from solver.scene.places import Places
from tests.fixtures import small_model
from tests.solver.block import head_block

MODEL = small_model()
JOINTS_ALONE = {"muscles": False}
UP = [{"time": 0, "rotation_deg": [-40, 0, 0]}]


def staged(scene: dict[str, Any]) -> Stage:
    played = read_scene(scene, SimulateScene)
    drives = drives_of(played, {}, MODEL, MODEL.weights)
    return Stage(played, Places(MODEL, {}), MODEL.weights, drives)


@pytest.mark.long
def test_the_head_goes_where_it_is_asked_to_on_a_torso_that_stands_still() -> None:
    stage = staged({"head": UP, "neck": JOINTS_ALONE})
    drive = stage.drive(0.0, stage.drives(0.0))
    np.testing.assert_allclose(drive.head.twist[:3], np.radians([-40.0, 0.0, 0.0]), atol=1e-6)
    assert stage.neck is not None
    assert stage.neck.skin is not None
    y = stage.simulator.rest(drive).y
    world = drive.head(stage.skin(y, drive.jaw, np.zeros((2, 3)), 0.0))
    rim = stage.neck.skin.rim
    np.testing.assert_allclose(world[rim], MODEL.skin.vertices[rim], atol=1e-9)
    lip = MODEL.region("lower_lip")
    drawn = np.linalg.norm(drive.head.inverse()(world)[lip] - MODEL.skin.vertices[lip], axis=1)
    assert drawn.max() > 0.2
    assert stage.count_inverted(y) == 0
    alone = staged({"head": UP, "neck": {**JOINTS_ALONE, "coupling": False}})
    still = alone.simulator.rest(alone.drive(0.0, alone.drives(0.0)))
    np.testing.assert_allclose(still.y, MODEL.rest, atol=1e-3)


def test_what_a_neck_cannot_do_is_held_and_told() -> None:
    far = [
        {"time": 0},
        {"time": 1, "rotation_deg": [0, 120, 0], "move_mm": [0, 30, 0]},
        {"time": 1.1, "rotation_deg": [0, -60, 0]},
    ]
    stage = staged({"fps": 10, "head": far, "duration": 1.2, "neck": JOINTS_ALONE})
    assert stage.neck is not None
    told = {notice.code: notice.context for notice in stage.neck.notices}
    assert told.keys() == {"neck.reach", "neck.range", "neck.speed"}
    assert told["neck.reach"]["moved_mm"] == pytest.approx(30.0, abs=0.1)
    most = stage.neck.placed.neck.head_range[1]
    assert stage.drive(1.0, stage.drives(1.0)).head.twist[1] == pytest.approx(most, abs=1e-6)
    assert stage.neck.report()["held_frames"] >= told["neck.range"]["count"] > 1
    assert stage.neck.arrays(stage.drives.times)["head_held"].sum() > 1


def test_a_push_moves_the_head_and_muscles_bring_it_back() -> None:
    pytest.importorskip("mujoco")
    push = {"time": 0.1, "seconds": 0.1, "at": [0, 80, 110], "newtons": [30, 0, 0]}
    scene = {"fps": 10, "duration": 1.0, "neck": {"pushes": [push]}}
    stage = staged(scene)
    again = staged(scene)
    assert stage.neck is not None
    assert again.neck is not None
    np.testing.assert_array_equal(stage.neck.motion.turns, again.neck.motion.turns)
    turned = np.degrees([stage.neck.head(time).twist[:3] for time in (0.0, 0.2, 1.0)])
    assert np.linalg.norm(turned[1]) > 1.0
    assert turned[1][1] > 0.5  # the forehead to the left
    assert np.linalg.norm(turned[2]) < 0.6 * np.linalg.norm(turned[1])
    [told] = stage.neck.notices
    assert (told.code, told.context["first_frame"]) == ("neck.behind", 2)
    assert told.context["off_deg"] > 5.0
    active = stage.neck.activations(0.2)
    assert active.shape == (len(stage.neck.placed.neck.muscles),)
    assert 0.0 <= active.min() < active.max() <= 1.0
    lying = staged({**scene, "neck": {}, "forces": [{"kind": "gravity", "mm_s2": [0, 0, -9810]}]})
    assert lying.neck is not None
    assert np.abs(lying.neck.motion.activations - stage.neck.motion.activations).max() > 0.01


def test_a_pull_at_the_skin_turns_the_head_as_it_grows() -> None:
    pytest.importorskip("mujoco")
    pull = {"kind": "point", "at": [25, -20, 90], "mn": [0, 0, 10_000], "ramp": 0.5}
    turned = {}
    for name, forces in (("without", []), ("pulled", [pull])):
        stage = staged({"fps": 10, "duration": 1.0, "neck": {}, "forces": forces})
        assert stage.neck is not None
        assert stage.neck.notices == []
        turned[name] = np.array([stage.neck.head(time).twist[1] for time in (0.0, 0.3, 0.8)])
    first, growing, whole = np.degrees(turned["pulled"] - turned["without"])
    assert abs(first) < 1e-6
    assert -0.05 > growing > whole  # its left side comes forward


def test_forces_that_the_neck_does_not_feel_are_told() -> None:
    pytest.importorskip("mujoco")
    pull = {"kind": "point", "at": [20, 0, 80], "mn": [0, 0, 10]}
    forces = [{"kind": "gravity"}, {"kind": "wind", "m_s": [0, 0, -20]}, pull]
    told = {}
    for muscles in (True, False):
        scene = {"fps": 5, "duration": 0.2, "neck": {"muscles": muscles}, "forces": forces}
        stage = staged(scene)
        assert stage.neck is not None
        told[muscles] = [(notice.code, notice.context) for notice in stage.neck.notices]
    assert told == {True: [("neck.forces", {"kinds": ["wind"]})], False: []}


def test_a_face_without_a_neck_is_refused_unless_its_skin_may_turn_whole() -> None:
    model = head_block((7, 5, 1))
    for entry, refused in ((JOINTS_ALONE, True), ({**JOINTS_ALONE, "skin": False}, False)):
        scene = read_scene({"neck": entry, "head": UP}, SimulateScene)
        drives = drives_of(scene, {}, model, model.weights)
        if refused:
            with pytest.raises(InputError) as caught:
                Stage(scene, Places(model, {}), model.weights, drives)
            assert caught.value.code == "neck.skin"
        else:
            stage = Stage(scene, Places(model, {}), model.weights, drives)
            assert stage.drive(0.0, stage.drives(0.0)).carried is None


@pytest.mark.long
def test_an_animation_has_the_joints_and_the_vertebrae(tmp_path: Path) -> None:
    rig = tmp_path / "rig.npz"
    Rig(MODEL, MODEL.weights, ()).save(rig)
    scene = {
        "fps": 5,
        "duration": 0.8,
        "neck": JOINTS_ALONE,
        "head": [{"time": 0}, {"time": 0.8, "rotation_deg": [10, 40, 5]}],
    }
    files = run_job("simulate", tmp_path / "out", options={"scene": scene}, rig=rig)
    assert "neck.png" in {file.name for file in files}
    report = json.loads((tmp_path / "out/animation.json").read_text())
    assert report["inverted"] == 0
    assert report["glb"]["max_error_mm"] < LIMIT_MM
    assert report["neck"]["held_frames"] == 0
    path = tmp_path / "out/animation.glb"
    names = ["start", *(f"shape_{k}" for k in range(1, report["glb"]["shapes"]))]
    assert validate_glb(path, names) == []
    document, _ = split_glb(path)
    joints = document["skins"][0]["joints"]
    assert [document["nodes"][number]["name"] for number in joints] == list(BODIES)
    assert document["scenes"][0]["nodes"] == [0, joints[0]]
    moved = {channel["target"]["node"] for channel in document["animations"][0]["channels"]}
    assert moved == {0, *joints[1:]}
    with np.load(tmp_path / "out/animation.npz") as data:
        skin = data["skin"]
        vertebrae = data["vertebrae"]
        faces = data["vertices"]
        times = data["time"]
    assert vertebrae.shape == (5, 8, 6)
    np.testing.assert_allclose(vertebrae[-1, -1, :3], np.radians([10, 40, 5]), atol=1e-5)
    shown = read_glb(path).at(times)
    np.testing.assert_allclose(shown[:, faces], skin, atol=LIMIT_MM)
    still = np.abs(shown - shown[0]).max(axis=(0, 2))
    assert (still < 1e-3).sum() > 10  # the rim


@pytest.mark.long
def test_a_scene_that_was_stopped_goes_on_with_the_same_neck(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    rig = tmp_path / "rig.npz"
    Rig(MODEL, MODEL.weights, ()).save(rig)
    head = [{"time": 0}, {"time": 0.6, "rotation_deg": [0, 25, 0]}]
    options = {"scene": {"fps": 5, "duration": 0.6, "neck": {}, "head": head}}

    told = list[Step]()

    def stop(step: Step, /) -> None:
        told.append(step)
        if step.iteration == 2:
            raise KeyboardInterrupt

    run_job("simulate", tmp_path / "whole", options=options, rig=rig)
    with pytest.raises(KeyboardInterrupt):
        run_job("simulate", tmp_path / "parts", options=options, rig=rig, progress=stop)
    assert [step.message for step in told if step.phase == "neck"] == ["0.0 of 0.6 s"]
    fractions = [step.fraction for step in told]
    assert fractions == sorted(fractions)
    assert len(list((tmp_path / "parts/frames").iterdir())) == 1
    run_job("simulate", tmp_path / "parts", options=options, rig=rig, resume=True)
    found = []
    for name in ("whole", "parts"):
        with np.load(tmp_path / name / "animation.npz") as data:
            found.append({key: data[key] for key in ("skin", "vertebrae", "neck_activations")})
    whole, parts = found
    np.testing.assert_array_equal(parts["vertebrae"], whole["vertebrae"])
    np.testing.assert_array_equal(parts["neck_activations"], whole["neck_activations"])
    np.testing.assert_allclose(parts["skin"], whole["skin"], atol=0.02)


def test_a_push_needs_muscles() -> None:
    push = {"time": 0.1, "at": [0, 80, 110], "newtons": [30, 0, 0]}
    with pytest.raises(ValidationError, match="needs muscles"):
        NeckEntry.model_validate({"muscles": False, "pushes": [push]})
