"""The service with stand-in solvers, what it is given to do, and what its tables say."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import select

from myoface.stack import Stack
from service.queue.states import FINAL, HELD
from service.store.database import Store
from service.store.models import Job, Worker
from tests.campaigns.chaos.crew import Crew
from tests.campaigns.chaos.places import Places
from tests.campaigns.chaos.station import Station
from tests.campaigns.customer import WHO_AM_I, Customer
from tests.service_client import ROOT, Studio, running

SETTINGS: dict[str, Any] = {
    "lease": 2.0,
    "beat": 0.2,
    "sweep": 0.5,
    "resend_after": 1.0,
    "max_attempts": 3,
    "garbage_age": 30.0,
    "jobs": "tests.standin.jobs",
    "live_workers": 1,
    "live_standby": 1,
    "solver_confined": False,  # a poison kills its worker
}
OTHER_HOST = ("long", "short")
KINDS = ("fit_geometry", "check_scan", "learn_controls", "fit_geometry", "build_model", "animate")
READS = (WHO_AM_I, ("GET", "/v1/jobs?limit=50", None), ("GET", "/v1/subjects", None))


@dataclass
class Stage:
    """Everything a blow may hit, and the jobs whose fate is counted.

    ``reader`` looks on as a page does, and ``station`` plays a live session, all the while. Of the
    ``spoilt`` jobs an input is damaged or lost, whose files are ``gone``.
    """

    stack: Stack
    studio: Studio
    store: Store
    dice: random.Random
    places: Places
    backup: Path
    reader: Customer
    station: Station
    subject: str  # of the station's rig
    waiting: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)
    good: list[str] = field(default_factory=list)
    poison: list[str] = field(default_factory=list)
    spoilt: list[str] = field(default_factory=list)
    gone: set[str] = field(default_factory=set)
    left_out: dict[str, str] = field(default_factory=dict)
    slowest_submission: float = 0.0

    def prepare(self, jobs: int, poison: int) -> None:
        """Upload the scans of all jobs, and submit the poison."""
        subject = self.subject
        rig = self.station.rig_id
        upload = self.studio.upload("take.csv", b"take")
        path = f"/v1/subjects/{subject}/captures"
        take = self.studio.post(path, name="take", role="asset", upload_id=upload)["id"]
        for number in range(jobs):
            seconds = round(self.dice.uniform(0.1, 1.5), 2)
            kind = KINDS[number % len(KINDS)]
            if kind == "build_model":
                self.waiting.append((kind, self.studio.subject(seconds=seconds), {}))
            elif kind == "animate":
                scene = {"recording": {"asset": "take"}, "neck": {}, "damping": seconds}
                options = {"scene": scene}
                how = {"rig_id": rig, "captures": [take], "options": options}
                self.waiting.append((kind, subject, how))
            elif kind == "learn_controls":
                lasting = {"seed": int(1000 * seconds)}
                self.waiting.append((kind, subject, {"rig_id": rig, "options": lasting}))
            else:
                name = f"expression{number}"
                capture = self.studio.capture(subject, name, seconds=seconds, child=30)
                self.waiting.append((kind, subject, {"captures": [capture]}))
        self.poison = [
            self.studio.submit("build_model", self.studio.subject(fault="poison"))
            for _ in range(poison)
        ]

    def submit(self, until: int) -> None:
        """Submit jobs until there are so many."""
        while self.waiting and len(self.good) < until:
            kind, subject, how = self.waiting.pop(0)
            began = time.monotonic()
            self.good.append(self.studio.submit(kind, subject, **how))
            self.slowest_submission = max(self.slowest_submission, time.monotonic() - began)

    def jobs(self) -> list[Job]:
        """Return the jobs whose fate is counted, as they are now."""
        with self.store.read() as session:
            counted = Job.id.in_([*self.good, *self.poison, *self.spoilt])
            return list(session.scalars(select(Job).where(counted)))

    def running(self) -> list[Job]:
        """Return the good jobs that workers hold."""
        return [job for job in self.jobs() if job.id in self.good and job.state in HELD]

    def target(self) -> Job | None:
        """Return a good job at work that can afford to lose an attempt."""
        if not self.nobody_is_on_the_last_try() or not self.until(self.running, seconds=10):
            return None
        return self.dice.choice(self.running() or [None])

    def is_held(self, job: Job) -> bool:
        """Whether a job's attempt is still that of who has it."""
        with self.store.read() as session:
            now = session.get(Job, job.id)
            return now is not None and now.state in HELD and now.attempt == job.attempt

    def leave_out(self, blow: str, reason: str) -> bool:
        """Note that a blow cannot be struck on this machine; returns that it hit nothing."""
        self.left_out[blow] = reason
        return False

    def are_over(self) -> bool:
        """Whether every job has ended."""
        return all(job.state in FINAL for job in self.jobs())

    def workers(self) -> list[str]:
        """Return the names of the workers that were alive a moment ago."""
        with self.store.read() as session:
            return list(session.scalars(select(Worker.name).order_by(Worker.name)))

    def nobody_is_on_the_last_try(self) -> bool:
        """Wait until no good job would fail of one more loss.

        Three tries are the limit; a good job must not be hit at its third, or it would rightly
        fail.
        """
        return self.until(
            lambda: (
                not any(
                    job.id in self.good
                    and job.state not in FINAL
                    and job.lost + 1 >= job.max_attempts
                    for job in self.jobs()
                )
            )
        )

    def until(self, condition: Callable[[], object], seconds: float = 30) -> bool:
        """Wait until ``condition`` holds; False: it does not, after so long."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.05)
        return True


@contextmanager
def stage(folder: Path, dice: random.Random, places: Places) -> Iterator[Stage]:
    """Run the service with a second host's workers, and somebody who reads."""
    with running(folder, **SETTINGS, **places.settings) as (stack, studio):
        studio.http.timeout = httpx.Timeout(30)
        settings = stack.settings
        store = Store(settings.database, settings.files, settings.broker)
        stop = threading.Event()
        reader = Customer("who reads", stack.url, stack.key, stop, READS)
        with Crew(settings, str(ROOT), OTHER_HOST):
            reader.start()
            backup = folder / "backup"
            subject, rig = studio.rigged()
            station = Station(stack.url, stack.key, rig)
            station.open()
            yield Stage(stack, studio, store, dice, places, backup, reader, station, subject)
            station.close()
            stop.set()
            reader.join()
        store.close()
