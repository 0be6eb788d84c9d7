import json

from solver.jobs import Task


def run(task: Task) -> None:
    (task.out / "tracks.npz").write_bytes(b"tracks of " + task.inputs["model"].read_bytes())
    (task.out / "tracks.json").write_text(json.dumps({"shapes": 51}))
