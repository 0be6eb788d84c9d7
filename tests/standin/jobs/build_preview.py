import json

from solver.jobs import Task
from solver.progress import Step


def run(task: Task) -> None:
    assert task.inputs["model"].name == "model.npz"
    assert task.inputs["weights"].name == "muscle_weights.npz"
    presets = json.loads(task.inputs["rig"].read_text())
    task.progress(Step("simulate", 0.5))
    told = [presets, task.options.model_dump(exclude_unset=True)]
    (task.out / "preview.bin").write_bytes(b"MYOV" + json.dumps(told).encode())
    (task.out / "preview.json").write_text(json.dumps({"controls": 3}))
