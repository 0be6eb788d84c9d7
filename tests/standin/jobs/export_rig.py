import json

from solver.jobs import Task
from tests.standin.rig import read_rig

FILES = {"usd": "rig.usdc", "glb": "rig.glb"}


def run(task: Task) -> None:
    names = read_rig(task.inputs)
    file = FILES[task.options.format]
    (task.out / file).write_text(f"{task.options.format} of {', '.join(names)}")
    (task.out / "export.json").write_text(json.dumps({"file": file}))
