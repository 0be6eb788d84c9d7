import json

from solver.jobs import Task
from tests.standin.rig import read_rig


def run(task: Task) -> None:
    names = " and ".join(read_rig(task.inputs))
    (task.out / "next_scan.json").write_text(json.dumps({"words": f"Shoot next: not {names}"}))
