import json

from solver.jobs import Task


def run(task: Task) -> None:
    (task.out / "edit.json").write_text(json.dumps({"edits": len(task.options.scene.edits)}))
