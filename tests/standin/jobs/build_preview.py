import json

from solver.jobs import Task
from solver.progress import Step
from tests.standin.rig import read_rig


def run(task: Task) -> None:
    presets = read_rig(task.inputs)
    task.progress(Step("simulate", 0.5))
    told = [presets, task.options.model_dump(exclude_unset=True)]
    (task.out / "preview.bin").write_bytes(b"MYOV" + json.dumps(told).encode())
    (task.out / "preview.json").write_text(json.dumps({"controls": 3}))
