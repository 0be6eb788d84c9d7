"""Frames of a scene, two a file; the scene's ``damping`` is the time for each file, s."""

import base64
import json
import time
from pathlib import Path

from solver.jobs import Task
from solver.progress import Step
from tests.standin.orders import SHOW, draw
from tests.standin.rig import read_rig

MOTION = {
    "activations": [[1, 0, 0, 1, 0, 1]],
    "jaw": [0] * 5,
    "head": [0] * 6,
    "eyes": [[0, 0, 0], [0, 0, 0]],
    "penetration_mm": 0.1,
    "behind_teeth": 0,
    "inverted": 0,
    "iterations": 3,
    "halvings": 0,
    "residual": 1e-6,
    "seconds": 0.1,
    "x": "eJwDAAAAAAE=",
}


def run(task: Task) -> None:
    read_rig(task.inputs)
    scene = task.options.scene
    folder = task.out / "frames"
    folder.mkdir(exist_ok=True)
    total = int((scene.duration or 1.0) * scene.fps)
    for first in range(2 * len(list(folder.iterdir())), total, 2):
        time.sleep(scene.damping if "damping" in scene.model_fields_set else 0)
        frames = [MOTION | {"frame": number, "time": number / 30} for number in (first, first + 1)]
        picture = _picture(task.out / "newest.png", first) if first % 4 == 0 else None
        partial = folder / "partial"
        partial.write_text(json.dumps({"frames": frames, "state": {}, "picture": picture}))
        partial.rename(folder / f"{first:06d}-{first + 1:06d}.json")
        words = f"frame {first + 1} of {total}"
        task.progress(Step("simulate", first / total, first + 2, message=words))
    fibres = task.inputs.get("fibre_muscles")
    figures = {
        "frames": total,
        "fibre_muscles": fibres and fibres.read_text(),
        "assets": {name: path.name for name, path in task.captures.items()},
        "penetration_max_mm": 0.12,
        "frame_ms": 410.0,
    }
    (task.out / "animation.json").write_text(json.dumps(figures))
    (task.out / "animation.mp4").write_bytes(b"film")
    if SHOW:
        (task.out / "newest.png").rename(task.out / "animation.png")


def _picture(path: Path, number: int) -> str:
    if not SHOW:
        return base64.b64encode(b"JPEG of %d" % number).decode()
    draw(path, f"frame {number}")
    return base64.b64encode(path.read_bytes()).decode()
