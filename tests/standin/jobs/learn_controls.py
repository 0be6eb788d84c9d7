"""Controls that are learned; the ``seed`` is the time that it takes, ms."""

import json
import time

from solver.jobs import Task
from solver.progress import Step


def run(task: Task) -> None:
    kept = task.out / "control_pairs.npz"
    known = kept if kept.is_file() else task.inputs.get("control_pairs")
    figures = {"pairs": known and known.read_text()}
    kept.write_text("solved")
    task.progress(Step("pairs", 0.5))
    time.sleep(task.options.seed / 1000)
    (task.out / "controls.npz").write_text("learned")
    (task.out / "controls.json").write_text(json.dumps(figures))
