"""``python -m tests.campaigns.two_hosts.run``, inside the stores' host: cut the link during a fit.

Once for longer than the worker's lease, then the first attempt is lost and the second does it; once
for less, then the first goes on. Either way the fit ends once and leaves one rig. The fit is the
tests' stand-in, which takes as long as it is told.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from typer import echo as say

from service.settings import Settings
from tests.campaigns.two_hosts.network import STORES_ADDRESS, WORK, Link, inside
from tests.servers import UnavailableError, free_port, listening, required
from tests.servers.postgres import postgres
from tests.servers.redis import redis
from tests.servers.s3 import s3
from tests.service_client import Studio

ROOT = Path(__file__).parents[3]
SWIFT = {"MYOFACE_BEAT": "0.5", "MYOFACE_SWEEP": "1", "MYOFACE_RESEND_AFTER": "1"}
QUEUES = ("short", "long")
FIT_S = 20
PATIENCE_S = 120.0
AWAKE_S = 30.0


@dataclass(frozen=True)
class Case:
    """A cut against a lease, and the outcomes of the attempts that it should lead to."""

    title: str
    lease: float
    outcomes: list[str]


def cases(cut: float) -> list[Case]:
    """Return a lease that a cut outlasts, and one that outlasts the cut."""
    return [
        Case("longer than the lease", cut / 3, ["lost", "succeeded"]),
        Case("shorter than the lease", cut * 3, ["succeeded"]),
    ]


def main() -> int:
    """Run both cases; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.two_hosts", description=__doc__
    )
    parser.add_argument("--cut", type=float, default=30, help="seconds without a link")
    cut = parser.parse_args().cut
    faults = []
    try:
        with (
            tempfile.TemporaryDirectory(prefix="myoface-hosts-") as folder,
            _stores(Path(folder)) as (environment, studio),
        ):
            subject = None
            for case in cases(cut):
                with _worker(Path(folder), environment, case.lease):
                    subject = subject or studio.modelled()
                    faults += _case(studio, subject, case, cut)
    except UnavailableError as error:
        say(f"skipped: {error}")
        return int(required())
    for fault in faults:
        say(f"fault: {fault}")
    return 1 if faults else 0


@contextmanager
def _stores(folder: Path) -> Iterator[tuple[dict[str, str], Studio]]:
    """Run database, broker, files and API; gives what a worker must know, and a client."""
    with ExitStack() as running:
        database = running.enter_context(postgres(STORES_ADDRESS))
        broker = running.enter_context(redis(folder, STORES_ADDRESS))
        files = running.enter_context(s3(folder / "s3", STORES_ADDRESS))
        parts = {
            "MYOFACE_DATABASE_URL": database,
            "MYOFACE_BROKER_URL": f"{broker}/0",
            "MYOFACE_FILES_URL": files,
            "PYTHONPATH": str(ROOT),
            "MYOFACE_JOBS": "tests.standin.jobs",
        }
        port = free_port("127.0.0.1")
        own = {"MYOFACE_DATA_DIR": str(folder / "api"), "MYOFACE_PORT": str(port)}
        command = [sys.executable, "-m", "service"]
        environment = os.environ | parts | own
        running.enter_context(
            listening(command, folder / "api.log", "127.0.0.1", port, env=environment)
        )
        key = Settings(data_dir=folder / "api").admin_key.read_text()
        url = f"http://127.0.0.1:{port}"
        http = running.enter_context(httpx.Client(base_url=url, timeout=30, trust_env=False))
        say("ok   the first host: PostgreSQL, Redis, S3, API")
        yield parts, Studio(http, key)


@contextmanager
def _worker(folder: Path, environment: dict[str, str], lease: float) -> Iterator[None]:
    """Run workers on the other host."""
    own = {"MYOFACE_DATA_DIR": str(folder / "work"), "MYOFACE_LEASE": str(lease)}
    with ExitStack() as running:
        for queue in QUEUES:
            command = [*inside(WORK), sys.executable, "-m", "worker", queue]
            log = folder / f"{queue}-{lease:.0f}.log"
            variables = os.environ | environment | SWIFT | own
            running.enter_context(listening(command, log, "", None, env=variables))
        yield


def _case(studio: Studio, subject: str, case: Case, cut: float) -> list[str]:
    """Cut the link in the middle of a fit; returns what was not as it should be."""
    name = f"lease{case.lease:.0f}"
    capture = studio.capture(subject, name, seconds=FIT_S)
    job_id = studio.submit("fit_geometry", subject, captures=[capture])
    _until(lambda: bool(studio.job(job_id)["progress"]), AWAKE_S)
    link = Link()
    link.cut()
    time.sleep(cut)
    link.mend()
    mended = time.monotonic()
    job = studio.finished(job_id, PATIENCE_S)
    rigs = [rig for rig in studio.get("/v1/rigs")["items"] if rig["job_id"] == job_id]
    story = [data["state"] for _, kind, data in studio.events(job_id) if kind == "state"]
    outcomes = [attempt["outcome"] for attempt in job["attempts"]]
    say(
        f"ok   a cut of {cut:.0f} s, {case.title} ({case.lease:.0f} s): {', '.join(outcomes)}; "
        f"{len(rigs)} rig, {time.monotonic() - mended:.0f} s after the link was back"
    )
    found = {"attempts": outcomes, "rigs": len(rigs), "ends": story.count("succeeded")}
    wanted = {"attempts": case.outcomes, "rigs": 1, "ends": 1}
    return [] if found == wanted else [f"{case.title}: {found}, not {wanted}"]


def _until(condition: Any, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError("the job did not begin")
        time.sleep(0.2)


if __name__ == "__main__":
    sys.exit(main())
