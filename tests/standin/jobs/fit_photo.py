import json

from solver.jobs import Task
from tests.standin.jobs.fit_sequence import fit_frames
from tests.standin.orders import draw, work
from tests.standin.rig import leave_rig, read_rig


def run(task: Task) -> None:
    assert task.inputs["tracks"].name == "tracks.npz"
    if task.options.sequence:
        fit_frames(task, task.inputs["film"])
        return
    work(task.captures.values(), task.progress, ["landmarks", "shading"])
    parent = read_rig(task.inputs) if "rig" in task.inputs else []
    leave_rig(task.out, task.captures, parent)
    (task.out / "photo.json").write_text(json.dumps({"expressions": {}}))
    draw(task.out / "photo.png", ", ".join(task.captures))
    (task.out / "photo.npz").write_bytes(b"cameras")
