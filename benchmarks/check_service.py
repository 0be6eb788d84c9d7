"""Time of a check through a running service, by its parts.

    python -m benchmarks.check_service --json -

Starts a service of its own with the defaults of `myoface up` and the solver's compiled kernels,
and asks it for checks of one raw scan, one after the other, as a capture station does. Load of the
machine at the start is among the figures: run it when nothing else works.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks import report
from benchmarks.documents import Section, Table
from myoface.client import Client
from myoface.resources import Job
from myoface.stack import Stack
from service.settings import Settings
from solver.meshio.obj import write_obj
from solver.surface import Surface
from solver.templates.builtin.build import builtin_expression
from worker.kernels import compile_all

VERTICES = 100_000
RUNS = 5
PAUSE_S = 3.0  # a station's pause: the next scan takes longer
LINE = re.compile(r"(\S+Z) \[info\s*\] (read|check|pictures|done)\b")
# Parts of a check, each from one moment to the next
PARTS = {
    "waiting": ("created", "started"),
    "start-up": ("started", "read"),
    "template": ("read", "check"),
    "check": ("check", "pictures"),
    "pictures": ("pictures", "done"),
    "commit": ("done", "finished"),
}


def main() -> None:
    """Run the benchmark."""
    parser = report.parser("a check through a service, and the share of it that is start-up")
    parser.add_argument("--vertices", type=int, default=VERTICES)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = run(Path(folder), options)
    report.finish(figures, options, section)


def run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return all figures; ``folder`` takes the files and the service's data."""
    scan = dense_scan(options.vertices, folder / "scan.obj")
    compile_all()
    load = os.getloadavg()[0]
    with _service(folder / "data") as client:
        subject = client.create_subject("timed").id
        _check(client, subject, scan, "first")  # what is read for the first time is read from disk
        checks = []
        for number in range(1 if options.quick else RUNS):
            time.sleep(PAUSE_S)
            checks.append(_check(client, subject, scan, f"scan-{number}"))
    middle = {part: median(each[part] for each in checks) for part in checks[0]}
    return {
        "vertices": options.vertices,
        "bytes": scan.stat().st_size,
        "load": round(load, 2),
        "checks": checks,
        "median": {part: round(seconds, 3) for part, seconds in middle.items()},
        "start_up_percent": round(100 * middle["start-up"] / middle["job"]),
    }


def dense_scan(vertices: int, path: Path) -> Path:
    """Write the built-in head with about so many vertices; what is too many goes from its back."""
    head = builtin_expression({})
    parts = math.ceil(math.sqrt(vertices / len(head.vertices)))  # of each edge
    grid = [(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    number = {place: index for index, place in enumerate(grid)}
    weights = np.array([(i, j, parts - i - j) for i, j in grid]) / parts
    upright = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in grid if i + j < parts]
    turned = [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in grid
        if i + j < parts - 1
    ]
    points = np.einsum("gc,fcx->fgx", weights, head.vertices[head.faces]).reshape(-1, 3)
    small = (np.arange(len(head.faces))[:, None, None] * len(grid)) + np.array(upright + turned)
    _, first, joined = np.unique(points.round(6), axis=0, return_index=True, return_inverse=True)
    faces = joined.reshape(-1)[small.reshape(-1, 3)]
    depth = points[first][faces].mean(axis=1)[:, 2]
    faces = faces[depth >= np.quantile(depth, max(0.0, 1.0 - vertices / len(first)))]
    used, faces = np.unique(faces, return_inverse=True)
    write_obj(path, Surface(points[first][used], faces.reshape(-1, 3)))
    return path


@contextmanager
def _service(data: Path) -> Iterator[Client]:
    settings = Settings(data_dir=data, port=0, webhook_workers=0)
    with Stack(settings) as stack, Client(stack.url, stack.key) as client:
        yield client


def _check(client: Client, subject: str, scan: Path, name: str) -> dict[str, float]:
    """Return the seconds of a scan's upload, of its check as a client sees it, and of its parts."""
    began = time.perf_counter()
    capture = client.add_capture(subject, scan, name=name, role="expression")
    uploaded = time.perf_counter()
    job = client.run("check_scan", subject, captures=[capture.id])
    ended = time.perf_counter()
    moments = _moments(job, [line.text for line in client.log(job.id)])
    parts = {
        part: (moments[end] - moments[start]).total_seconds()
        for part, (start, end) in PARTS.items()
    }
    told = {"upload": uploaded - began, "job": ended - uploaded, **parts}
    return {part: round(seconds, 3) for part, seconds in told.items()}


def _moments(job: Job, lines: list[str]) -> dict[str, datetime]:
    """Return when a check began and ended, by the job, and its steps in between, by its log."""
    found = filter(None, map(LINE.match, lines))
    ends = {"created": job.created_at, "started": job.started_at, "finished": job.finished_at}
    told = {match[2]: datetime.fromisoformat(match[1]) for match in found}
    return told | {name: moment for name, moment in ends.items() if moment is not None}


def section(figures: dict[str, Any]) -> Section:
    """Return the document's section."""
    middle = figures["median"]
    rows = [[part, middle[part], *(each[part] for each in figures["checks"])] for part in middle]
    count = len(figures["checks"])
    return Section(
        title="A check through the service",
        compared=(
            f"A raw scan of {figures['vertices']:,} vertices ({figures['bytes'] / 1e6:.0f} MB), "
            f"uploaded and checked {count} times by a client on the same machine; `job` is from "
            "its submission to the client's having the result, the lines below it are its parts. "
            f"{figures['start_up_percent']} % of it is the start of the solver's process. Load of "
            f"the machine before: {figures['load']}."
        ),
        parts=[Table(["seconds", "median", *map(str, range(1, count + 1))], rows)],
    )


if __name__ == "__main__":
    main()
