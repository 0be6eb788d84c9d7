"""A worker that has died is missed at once on its host."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.queue import table
from service.queue.states import State
from service.queue.wakeups import LIVE, WAKE
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Job, Subject
from tests.stores import open_store
from worker.lookout import Lookout, Presence

LIVES = """
import sys, time
from pathlib import Path
from worker.lookout import Presence
presence = Presence(Path(sys.argv[1]), "host:1")
print("lives", flush=True)
time.sleep(60)
"""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as store:
        yield store


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Another worker of this host."""
    command = [sys.executable, "-c", LIVES, str(tmp_path / "work")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process
        process.kill()


def _session(store: Store, worker: str | None) -> str:
    with store.write() as session:
        session.add(subject := Subject(tenant_id=DEFAULT_TENANT, name="Alex"))
        session.flush()
        what: dict[str, Any] = {"kind": "live_session", "queue": LIVE, "inputs": []}
        request = {"options": {}, "rig_id": None}
        mine = {"tenant_id": DEFAULT_TENANT, "subject_id": subject.id}
        job = Job(request=request, max_attempts=10, **what, **mine)
        table.create(session, job)
        session.info.pop(WAKE)
        if worker is not None:
            assert table.take(session, job.id, worker, 30)
        return job.id


def _state(store: Store, job_id: str) -> State:
    with store.read() as session:
        return session.get_one(Job, job_id).state


def _look(
    store: Store, folder: Path, monkeypatch: pytest.MonkeyPatch, silence: float = 10.0
) -> list[str]:
    """Return the sessions that a lookout wakes its worker for."""
    woken: list[str] = []
    monkeypatch.setattr(store._wake_ups, "send", lambda job_id, _queue: woken.append(job_id))
    presence = Presence(folder, "host:2")
    Lookout(store, presence, silence, lambda: True, threading.Event())._look()
    return woken


def test_the_sessions_of_a_dead_worker_go_on_before_their_lease_is_over(
    store: Store, other: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "work"
    held = _session(store, "host:1")
    elsewhere = _session(store, "elsewhere:1")
    assert _look(store, folder, monkeypatch) == []
    os.kill(other.pid, signal.SIGKILL)
    other.wait()
    assert _look(store, folder, monkeypatch) == [held]
    assert (_state(store, held), _state(store, elsewhere)) == (State.QUEUED, State.RUNNING)
    assert Presence(folder, "host:3").is_alive("host:1") is None  # it has been dealt with


def test_only_a_worker_elsewhere_is_lost_when_it_is_silent(
    store: Store, other: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = _session(store, "host:1")
    elsewhere = _session(store, "elsewhere:1")
    time.sleep(2.1)
    assert _look(store, tmp_path / "work", monkeypatch, silence=2.0) == [elsewhere]
    assert (_state(store, held), _state(store, elsewhere)) == (State.RUNNING, State.QUEUED)


def test_sessions_of_a_worker_that_had_the_same_name_are_lost(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A container that is restarted has the host's name and often the process's number again."""
    before = _session(store, "host:2")
    time.sleep(0.01)
    assert _look(store, tmp_path / "work", monkeypatch) == [before]


def test_a_worker_is_woken_for_what_waits(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = _session(store, None)
    assert _look(store, tmp_path / "work", monkeypatch) == [waiting]
