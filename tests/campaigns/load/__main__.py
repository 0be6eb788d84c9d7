"""``python -m tests.campaigns.load``: eight stations upload 20 MB scans while two workers fit.

The service is a stack of its own in a temporary folder, with the real solver on a coarse mesh of
the built-in face. Prints the tables; exits with 1 if a read's p95 is 150 ms or more, anything was
refused, or the memory of a process grows.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path

import trimesh
from typer import echo as say

from myoface.client import Client
from myoface.resources import Job
from myoface.stack import Stack
from service.queue.wakeups import QUEUES
from service.settings import Settings
from solver.templates.builtin.build import builtin_capture_set
from tests.campaigns.load.measure import Answers, Memory, table
from tests.campaigns.load.station import Station

MOST_READ_S = 0.15
MOST_GROWTH = 5.0
"""MB a minute."""

SCAN_BYTES = 20 * 1000**2
SAMPLE_EVERY = 2.0
COARSE = {"edge_mm": 16.0}
ROUNDS = {"rounds": 2}
EXPRESSIONS = 3


def main() -> int:
    """Run the load; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.load", description=__doc__)
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--stations", type=int, default=8)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="myoface-load-") as folder:
        settings = Settings(
            data_dir=Path(folder), port=0, long_workers=2, solver_threads=1, ingest_workers=1
        )
        with Stack(settings) as stack:
            return _run(stack, given.seconds, given.stations)


def _run(stack: Stack, seconds: float, stations: int) -> int:
    answers = Answers()
    stop = threading.Event()
    content = _scan()
    with Client(stack.url, stack.key) as client:
        fits = _Fits(client, stack.settings.data_dir)
        fits.keep_two()
        crew = [
            Station(number, stack.url, stack.key, content, answers, stop)
            for number in range(stations)
        ]
        memory = Memory({name: stack.pid(name) for name in ("api", *QUEUES)})
        for station in crew:
            station.start()
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            memory.sample()
            fits.keep_two()
            time.sleep(SAMPLE_EVERY)
        stop.set()
        for station in crew:
            station.join()
        working = fits.share_of_two()
    return _tell(answers, memory, sum(station.uploads for station in crew), working, seconds)


class _Fits:
    """Keeps two fits at work on one subject."""

    def __init__(self, client: Client, folder: Path) -> None:
        self._client = client
        scans = builtin_capture_set().write(folder / "scans")
        self._subject = client.create_subject("fitted").id
        client.add_capture(self._subject, scans["neutral"], role="neutral", registered=True)
        names = [name for name in scans if name != "neutral"][:EXPRESSIONS]
        self._captures = [
            client.add_capture(self._subject, scans[name], role="expression", registered=True).id
            for name in names
        ]
        client.run("build_model", self._subject, options=COARSE)
        self._jobs: list[str] = []
        self._looks = 0
        self._both = 0

    def keep_two(self) -> None:
        """Submit another fit for each that has ended, with one waiting."""
        jobs = [self._client.job(each) for each in self._jobs]
        active = [job for job in jobs if job.state in ("queued", "running")]
        self._refuse_failures(jobs)
        self._looks += 1
        self._both += sum(job.state == "running" for job in active) >= 2
        self._jobs = [job.id for job in active]
        while len(self._jobs) < 3:
            job = self._client.submit(
                "fit_geometry", self._subject, captures=self._captures, options=ROUNDS
            )
            self._jobs.append(job.id)

    def share_of_two(self) -> float:
        """Return the share of looks at which two were running."""
        return self._both / self._looks

    @staticmethod
    def _refuse_failures(jobs: list[Job]) -> None:
        for job in jobs:
            if job.state == "failed":
                raise RuntimeError(f"a fit failed: {job.error}")


def _scan() -> bytes:
    """Return the built-in neutral, fine enough for a file of 20 MB."""
    with tempfile.TemporaryDirectory() as folder:
        mesh = trimesh.load_mesh(builtin_capture_set().write(Path(folder))["neutral"])
    while len(content := str(mesh.export(file_type="obj")).encode()) < SCAN_BYTES:
        mesh = mesh.subdivide()
    return content[: content.rindex(b"\n", 0, SCAN_BYTES) + 1]


def _tell(answers: Answers, memory: Memory, uploads: int, working: float, seconds: float) -> int:
    head = ["route", "n", "p50 ms", "p95 ms", "p99 ms", "max ms", "errors"]
    say(table(head, answers.rows()) + "\n")
    say(table(["process", "MB start", "middle", "end", "MB/min"], memory.rows()) + "\n")
    say(f"{uploads} scans in {seconds:.0f} s; two fits at work {working:.0%} of the time")
    faults = answers.errors()[:10]
    if (worst := answers.worst_read()) >= MOST_READ_S:
        faults.append(f"p95 of a read is {1000 * worst:.0f} ms")
    for name in memory.samples:
        if (slope := memory.slope(name)) >= MOST_GROWTH:
            faults.append(f"the memory of {name} grows by {slope:.1f} MB a minute")
    say("\n".join(f"fault: {fault}" for fault in faults) or "all as promised")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
