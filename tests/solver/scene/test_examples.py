"""The example scenes are scenes, and name what the built-in person has."""

import json
import re
from pathlib import Path

import pytest

from solver.kinds.scene import EditScene, SimulateScene
from solver.registration.landmarks import landmark_vertices
from solver.scene.document import document_of, read_scene
from solver.templates.builtin.build import builtin_template

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "docs" / "examples" / "scenes"
SCENES = sorted(path.name for path in FOLDER.glob("*.json"))


def named(value, key):
    """Return all strings under a key, and in lists under it."""
    if isinstance(value, dict):
        for name, inner in value.items():
            found = [inner] if isinstance(inner, str) else inner if isinstance(inner, list) else []
            if name == key:
                yield from (each for each in found if isinstance(each, str))
            yield from named(inner, key)
    elif isinstance(value, list):
        for each in value:
            yield from named(each, key)


@pytest.mark.parametrize("name", SCENES)
def test_an_example_is_a_scene_of_the_built_in_person(name):
    scene = json.loads((FOLDER / name).read_text())
    read_scene(scene, SimulateScene if {"keys", "head", "performance"} & set(scene) else EditScene)
    template = builtin_template()
    assert {*named(scene, "at"), *named(scene, "spots")} <= set(landmark_vertices(template))
    assert set(named(scene, "regions")) <= set(template.regions)
    shapes = {name for key in scene.get("keys", []) for name in key.get("shapes", {})}
    assert bool(shapes) == (scene.get("drive") == "tracks")
    assert template.shapes is not None
    assert shapes <= set(template.shapes.expression_names)


def test_the_scenes_of_the_documentation_are_some():
    text = (ROOT / "docs" / "guide" / "simulation.md").read_text()
    muscles = set()
    for document in re.findall(r"```json\n(.*?)```", text, re.DOTALL):
        scene = document_of(read_scene(json.loads(document), SimulateScene))
        muscles |= {name for key in scene.get("keys", []) for name in key.get("muscles", {})}
        performed = scene.get("performance", [])
        for entry in performed if isinstance(performed, list) else [performed]:
            muscles |= {*entry.get("muscles", {}), *entry.get("mask", [])}
    assert len(muscles) > 5
    assert muscles <= {muscle.name for muscle in builtin_template().muscles}


def test_all_examples_are_told_of():
    told = (FOLDER / "README.md").read_text()
    assert SCENES
    assert all(f"`{name}`" in told for name in SCENES)
