"""A recording that is played; the scene's ``damping`` is the time that it takes, s."""

import json
import time

from solver.jobs import Task
from solver.progress import Step


def run(task: Task) -> None:
    scene = task.options.scene
    if scene.neck is not None:
        task.progress(Step("neck", 0.1))
    time.sleep(scene.damping if "damping" in scene.model_fields_set else 0)
    recording = task.captures[scene.recording.asset]
    if recording.suffix == ".mp4":
        (task.out / "signals.csv").write_text("measured")
    shapes = task.inputs.get("blendshapes")
    (task.out / "blendshapes.npz").write_text("solved")
    figures = {"blendshapes": shapes and shapes.read_text(), "recording": recording.name}
    (task.out / "animation.json").write_text(json.dumps(figures))
