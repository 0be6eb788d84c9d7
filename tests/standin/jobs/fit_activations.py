from solver.jobs import Task
from tests.standin.orders import work
from tests.standin.rig import leave_rig, read_rig


def run(task: Task) -> None:
    work(task.captures.values(), task.progress, ["activations", "export"])
    leave_rig(task.out, task.captures, read_rig(task.inputs))
