import json

from solver.jobs import Task
from tests.standin.orders import work
from tests.standin.rig import leave_rig


def run(task: Task) -> None:
    assert task.inputs["weights"].name == "muscle_weights.npz"
    work(task.captures.values(), task.progress, ["activations", "export"])
    leave_rig(task.out, task.captures, json.loads(task.inputs["rig"].read_text()))
