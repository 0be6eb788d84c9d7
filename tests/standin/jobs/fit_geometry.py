from solver.jobs import Task
from tests.standin.orders import work
from tests.standin.rig import leave_rig


def run(task: Task) -> None:
    assert task.inputs["model"].read_bytes().startswith(b"model of")
    work(task.captures.values(), task.progress, ["geometry", "activations", "export"])
    leave_rig(task.out, task.captures)
