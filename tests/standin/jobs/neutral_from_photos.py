import json

from solver.jobs import Task
from tests.standin.orders import draw, work


def run(task: Task) -> None:
    work(task.captures.values(), task.progress, ["fit"])
    (task.out / "neutral.ply").write_text("# estimated\n")
    (task.out / "neutral.json").write_text(json.dumps({"size_from": "photographs"}))
    draw(task.out / "neutral.png", ", ".join(task.captures))
