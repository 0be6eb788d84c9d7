import json

from solver.jobs import Task
from tests.standin.orders import SHOW, draw, work


def run(task: Task) -> None:
    neutral = task.inputs["neutral"]
    template = task.inputs.get("template")
    work([neutral], task.progress, ["mesh", "relax", "muscles"])
    (task.out / "model.npz").write_bytes(b"model of " + neutral.read_bytes())
    figures = {"template": template and template.name, "tets": 24816, "muscles": 43}
    (task.out / "model.json").write_text(json.dumps(figures))
    if SHOW:
        draw(task.out / "anatomy.png", neutral.name)
