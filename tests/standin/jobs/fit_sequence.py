"""Frames, two a file, as the orders say: ``frames`` in all, ``seconds`` for each."""

import json
import time
from pathlib import Path

from solver.jobs import Task
from solver.progress import Step
from tests.standin.orders import fail, orders_of

FRAME = {
    "status": "fitted",
    "activations": [[1, 0, 0, 1, 0, 1]],
    "jaw": [0] * 5,
    "head": [0] * 6,
    "mean_mm": 0.25,
    "p95_mm": 0.5,
    "max_mm": None,
    "coverage": 1,
    "inverted": 0,
    "seconds": 0.1,
}


def run(task: Task) -> None:
    fit_frames(task, task.inputs["performance"])


def fit_frames(task: Task, performance: Path) -> None:
    """Leave the frames and the sequence that the orders in a file ask for."""
    orders = orders_of(performance)
    folder = task.out / "frames"
    total = int(orders["frames"])
    assert task.resume == folder.exists()
    folder.mkdir(exist_ok=True)
    done = 2 * len(list(folder.iterdir()))
    for first in range(done, total, 2):
        time.sleep(float(orders.get("seconds", 0)))
        frames = [FRAME | {"frame": number, "iterations": done} for number in (first, first + 1)]
        partial = folder / "partial"
        partial.write_text(json.dumps({"frames": frames}))
        partial.rename(folder / f"{first:06d}-{first + 1:06d}.json")
        task.progress(Step("frames", first / total, first + 2))
        if first == 2 and not task.resume:
            fail(orders.get("fault"), performance)
    (task.out / "sequence.npz").write_bytes(b"PK")
    (task.out / "sequence.json").write_text(json.dumps({"frames": total}))
