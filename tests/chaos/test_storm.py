"""Many jobs under many blows: each ends exactly once, poison is given up, nothing is left over."""

from __future__ import annotations

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
import redis

from myoface.stack import Stack
from tests.service_client import FINAL, Studio, eventually, running

SEED = 20_180
JOBS = 30
BLOWS = 12
PATIENT = {"lease": 2.0, "max_attempts": 8}


@pytest.mark.slow
def test_every_job_ends_exactly_once(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    with running(tmp_path, **PATIENT) as (stack, studio):
        subject = studio.modelled()
        good = [_submit(studio, subject, number, dice) for number in range(JOBS)]
        poison = studio.submit("build_model", studio.subject(fault="poison"))
        blows = _blows(stack, studio)
        for _ in range(BLOWS):
            time.sleep(dice.uniform(0.5, 2))
            blows[dice.randrange(len(blows))]()
        ended = {job: _finished(studio, job) for job in [*good, poison]}
        rigs = Counter(rig["job_id"] for rig in studio.get("/v1/rigs")["items"])
        stories = {
            job: [e[2]["state"] for e in studio.events(job) if e[1] == "state"] for job in good
        }
        eventually(lambda: not any(stack.settings.work.iterdir()))
        assert not studio.solvers(stack)
    for job in good:
        assert ended[job]["state"] == "succeeded", ended[job]
        assert stories[job].count("succeeded") == 1
        assert [a["outcome"] for a in ended[job]["attempts"]].count("succeeded") == 1
        assert rigs[job] == (ended[job]["kind"] == "fit_geometry")
    assert ended[poison]["error"]["code"] == "worker_lost"
    assert len(ended[poison]["attempts"]) == PATIENT["max_attempts"]


def _submit(studio: Studio, subject: str, number: int, dice: random.Random) -> str:
    """Submit a fit, or as every third job a check."""
    seconds = round(dice.uniform(0.1, 1), 2)
    capture = studio.capture(subject, f"expression{number}", seconds=seconds, child=30)
    kind = "fit_geometry" if number % 3 else "check_scan"
    return studio.submit(kind, subject, captures=[capture])


def _blows(stack: Stack, studio: Studio) -> list[Callable[[], None]]:
    def kill(name: str) -> None:
        _ignoring_the_dead(lambda: os.kill(stack.pid(name), signal.SIGKILL))

    def kill_solvers() -> None:
        for pid in studio.solvers(stack):
            _ignoring_the_dead(lambda pid=pid: os.kill(pid, signal.SIGKILL))

    def empty_broker() -> None:
        with redis.Redis(unix_socket_path=str(stack.settings.broker_socket)) as client:
            _ignoring_the_dead(client.flushall)

    def freeze_worker() -> None:
        pid = stack.pid("long")
        _ignoring_the_dead(lambda: os.kill(pid, signal.SIGSTOP))
        time.sleep(PATIENT["lease"] + 1)
        _ignoring_the_dead(lambda: os.kill(pid, signal.SIGCONT))

    names = ("long", "long", "short", "ingest", "broker", "api")
    kills = [lambda name=name: kill(name) for name in names]
    return [*kills, kill_solvers, empty_broker, freeze_worker]


def _ignoring_the_dead(blow: Callable[[], object]) -> None:
    try:
        blow()
    except (ProcessLookupError, redis.RedisError):
        return  # an earlier blow has hit it, and it is not back yet


def _finished(studio: Studio, job: str) -> dict:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        try:
            found = studio.job(job)
        except httpx.TransportError:  # the API is being started again
            time.sleep(0.2)
            continue
        if found["state"] in FINAL:
            return found
        time.sleep(0.2)
    raise AssertionError(found)
