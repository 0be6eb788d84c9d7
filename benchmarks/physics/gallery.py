"""The README's picture of living flesh: the last moments of some scenes, on one fitted person."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import trimesh

from benchmarks.physics.fitted import Fitted
from benchmarks.physics.headset import headset
from benchmarks.physics.jobs import FOLDER
from solver.jobs.scenes import play, skin_of
from solver.kinds.scene import SimulateScene
from solver.rig.frames.animation import Filming, Shot, contact_sheet
from solver.scene import Stage
from solver.scene.document import drives_of, read_scene
from solver.scene.places import Places

SMILE = [{"time": 0}, {"time": 0.5, "expressions": {"smile": 1}}]
HEADSET = {
    "duration": 0.5,
    "objects": [
        {
            "name": "headset",
            "mesh": {"asset": "headset"},
            "path": [{"time": 0}, {"time": 0.5, "move_mm": [0, 0, -10]}],
        }
    ],
}
APART_MM = 2.0
PRESSED_MM = 8.0


def gallery(person: Fitted, template: Path, path: Path) -> None:
    """Play the scenes and draw their ends, from the front and from the side."""
    scenes = {
        "fatter": {"keys": SMILE, **_example("fat")},
        "Bell's palsy": {"keys": SMILE, **_example("palsy")},
        "lips on glass": _example("kiss_on_glass"),
        "a headset, 8 mm deep": HEADSET,
    }
    with tempfile.TemporaryDirectory() as folder:
        worn = headset(person.model, APART_MM, PRESSED_MM)
        thing = Path(folder) / "headset.obj"
        trimesh.Trimesh(worn.vertices, worn.faces, process=False).export(thing)
        places = Places.of(person.model, template, {"headset": thing})
        shots = [
            _end(person, places, title, scene, Path(folder)) for title, scene in scenes.items()
        ]
    filming = Filming(person.model)
    contact_sheet(filming, shots, "Living flesh", "one fitted person, four scenes", path)


def _example(name: str) -> dict[str, Any]:
    scene: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text())
    return scene


def _end(
    person: Fitted, places: Places, title: str, scene: Mapping[str, Any], folder: Path
) -> Shot:
    """Play a scene and return its last frame."""
    played = read_scene(scene, SimulateScene)
    drives = drives_of(played, person.poses, person.model, person.S)
    stage = Stage(played, places, person.S, drives)
    last = play(stage, folder / title, title)[-1]
    return Shot(
        title,
        last.into_world(skin_of(stage, last)),
        tuple(each.at(last.time) for each in stage.objects),
    )
