"""Processes killed in the middle of a fit: the job ends once, with its attempts on record."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import redis

from myoface.stack import Stack
from service.settings import Settings
from service.uploads.service import COUNT_EVERY
from tests.service_client import OFFSET_STREAM, ROOT, Studio, eventually, running, served

LEASE = 2.0
LAUNCH = """
import sys, time
from pathlib import Path
from service.queue.wakeups import LIVE, QUEUES
from tests.kills.test_kills import _fit
from tests.service_client import running

with running(Path(sys.argv[1]), lease=2) as (stack, studio):
    job = _fit(studio, seconds=2)
    names = [name for name in QUEUES if name != LIVE]  # of which there is no worker here
    processes = [stack.pid(name) for name in ("api", *names)] + studio.solvers(stack)
    print("working", job, *processes, flush=True)
    time.sleep(60)
"""


@pytest.fixture(scope="module")
def stack_and_studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stack, Studio]]:
    # A poison kills its worker, which a confined solver cannot.
    folder = tmp_path_factory.mktemp("kills")
    with running(folder, lease=LEASE, solver_confined=False) as both:
        yield both


def test_a_killed_worker_costs_an_attempt(stack_and_studio: tuple[Stack, Studio]) -> None:
    stack, studio = stack_and_studio
    job = _fit(studio, seconds=2, child=60)
    processes = studio.solvers(stack)
    assert len(processes) == 2
    os.kill(stack.pid("long"), signal.SIGKILL)
    _until_gone(processes)
    done = studio.finished(job)
    assert done["state"] == "succeeded", done
    assert [a["outcome"] for a in done["attempts"]] == ["lost", "succeeded"]
    _check_once(studio, done)


def test_a_killed_broker_costs_nothing(stack_and_studio: tuple[Stack, Studio]) -> None:
    stack, studio = stack_and_studio
    job = _fit(studio, seconds=2)
    os.kill(stack.pid("broker"), signal.SIGKILL)
    waiting = studio.submit("build_model", studio.subject())
    for one in (job, waiting):
        done = studio.finished(one)
        assert done["state"] == "succeeded", done
        assert [a["outcome"] for a in done["attempts"]] == ["succeeded"]
        _check_once(studio, done)


@pytest.mark.slow
def test_a_broker_s_damaged_file_costs_no_start_and_no_job(tmp_path: Path) -> None:
    """Zeros in a file of the broker's, as a power cut leaves them: releases before kept some."""
    with served(Settings(data_dir=tmp_path)) as studio:
        jobs = [studio.submit("build_model", studio.subject()) for _ in range(3)]
    kept = tmp_path / "broker" / "appendonlydir"
    kept.mkdir(parents=True)
    (kept / "appendonly.aof.manifest").write_bytes(bytes(64))
    with running(tmp_path, lease=LEASE) as (_, studio):
        for job in jobs:
            done = studio.finished(job)
            assert [a["outcome"] for a in done["attempts"]] == ["succeeded"]
            _check_once(studio, done)


def test_a_killed_api_keeps_what_has_arrived_of_an_upload(
    stack_and_studio: tuple[Stack, Studio],
) -> None:
    stack, studio = stack_and_studio
    scan = os.urandom(3 * COUNT_EVERY)
    sent = 2 * COUNT_EVERY + COUNT_EVERY // 2
    location = studio.start_upload("smile.obj", len(scan), hashlib.sha256(scan).hexdigest())

    def offset() -> int:
        with contextlib.suppress(httpx.TransportError):  # the API starts anew
            return int(studio.http.get(location).json()["offset"])
        return -1

    with socket.create_connection((stack.settings.host, stack.settings.port)) as connection:
        head = (
            f"PATCH {location} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpload-Offset: 0\r\n"
            f"Authorization: Bearer {studio.key}\r\n"
            f"Content-Type: {OFFSET_STREAM}\r\nContent-Length: {len(scan)}\r\n\r\n"
        )
        connection.sendall(head.encode() + scan[:sent])
        eventually(lambda: offset() >= 2 * COUNT_EVERY, seconds=20)
        os.kill(stack.pid("api"), signal.SIGKILL)
    eventually(lambda: offset() >= 0, seconds=60)
    assert 2 * COUNT_EVERY <= (found := offset()) <= sent
    assert studio.send(location, found, scan[found:]).status_code == 204
    assert studio.get(location)["state"] == "complete"


@pytest.mark.slow
def test_a_killed_solver_is_tried_again(stack_and_studio: tuple[Stack, Studio]) -> None:
    stack, studio = stack_and_studio
    job = _fit(studio, seconds=2)
    for pid in studio.solvers(stack):
        os.kill(pid, signal.SIGKILL)
    done = studio.finished(job)
    assert [a["outcome"] for a in done["attempts"]] == ["lost", "succeeded"]
    _check_once(studio, done)


@pytest.mark.slow
def test_a_worker_that_outlives_its_lease_is_fenced_off(
    stack_and_studio: tuple[Stack, Studio],
) -> None:
    stack, studio = stack_and_studio
    job = _fit(studio, seconds=3)
    stopped = stack.pid("long")
    os.kill(stopped, signal.SIGSTOP)
    try:
        studio.until(job, "queued", seconds=4 * LEASE)
    finally:
        os.kill(stopped, signal.SIGCONT)
    done = studio.finished(job)
    assert done["state"] == "succeeded", done
    assert [a["outcome"] for a in done["attempts"]] == ["lost", "succeeded"]
    _check_once(studio, done)


@pytest.mark.slow
def test_an_emptied_broker_loses_nothing(stack_and_studio: tuple[Stack, Studio]) -> None:
    stack, studio = stack_and_studio
    jobs = [_fit(studio, seconds=1)]
    jobs += [studio.submit("build_model", studio.subject()) for _ in range(5)]
    with redis.Redis(unix_socket_path=str(stack.settings.broker_socket)) as client:
        client.flushall()
    for job in jobs:
        done = studio.finished(job)
        assert [a["outcome"] for a in done["attempts"]] == ["succeeded"]


@pytest.mark.slow
def test_a_killed_service_goes_on_when_it_is_started_again(tmp_path: Path) -> None:
    """The launcher is killed: all but the broker die with it, and the next start takes over."""
    command = [sys.executable, "-c", LAUNCH, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as launcher:
        assert launcher.stdout
        line = next(line for line in launcher.stdout if line.startswith("working "))
        _, job, *processes = line.split()
        launcher.kill()
    _until_gone([int(pid) for pid in processes])
    with running(tmp_path, lease=LEASE) as (stack, studio):
        done = studio.finished(job)
        broker = stack.pid("broker")
        _check_once(studio, done)
    assert [a["outcome"] for a in done["attempts"]][-1] == "succeeded"
    _until_gone([broker])


@pytest.mark.slow
def test_poison_is_given_up_after_three_attempts(stack_and_studio: tuple[Stack, Studio]) -> None:
    _, studio = stack_and_studio
    job = studio.finished(studio.submit("build_model", studio.subject(fault="poison")), seconds=60)
    assert job["state"] == "failed"
    assert job["error"]["code"] == "worker_lost"
    assert [a["outcome"] for a in job["attempts"]] == ["lost"] * 3
    studio.modelled()


@pytest.mark.slow
def test_a_cancel_that_no_worker_confirms_is_closed(stack_and_studio: tuple[Stack, Studio]) -> None:
    stack, studio = stack_and_studio
    job = _fit(studio, seconds=30)
    stopped = stack.pid("long")
    os.kill(stopped, signal.SIGSTOP)
    studio.post(f"/v1/jobs/{job}/cancel", reason="no answer")
    done = studio.finished(job, seconds=4 * LEASE)
    os.kill(stopped, signal.SIGCONT)
    assert done["state"] == "canceled"
    _until_gone(studio.solvers(stack))


def _fit(studio: Studio, **orders: float) -> str:
    """Return a fit that has begun."""
    subject = studio.modelled()
    capture = studio.capture(subject, "smile", **orders)
    job = studio.submit("fit_geometry", subject, captures=[capture])
    studio.until_working(job)
    return job


def _check_once(studio: Studio, job: dict) -> None:
    """The job succeeded once, and there is one rig or model of it."""
    states = [event[2]["state"] for event in studio.events(job["id"]) if event[1] == "state"]
    assert states.count("succeeded") == 1
    rigs = studio.get(f"/v1/rigs?subject_id={job['subject_id']}")["items"]
    assert len(rigs) == (job["kind"] != "build_model")


def _until_gone(processes: list[int]) -> None:
    eventually(lambda: not any(_lives(pid) for pid in processes), seconds=5)


def _lives(pid: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
