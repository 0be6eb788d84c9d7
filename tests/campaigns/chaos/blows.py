"""What goes wrong in a machine room. Each blow tells whether it hit something."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing

import redis
from sqlalchemy import func, select

from service.queue.states import HELD
from service.store.database import Database
from service.store.models import Attempt, Job, Lease
from tests.campaigns.chaos.stage import SETTINGS, Stage

LEASE = SETTINGS["lease"]
PAUSE = 6.0


def kill_worker(stage: Stage) -> bool:
    """Kill a worker, one that is at a job if there is one."""
    if not stage.nobody_is_on_the_last_try():
        return False
    stage.until(stage.running, seconds=5)
    busy = [job.lease_owner for job in stage.running() if job.lease_owner]
    return _signal(stage.dice.choice(busy or stage.workers()), signal.SIGKILL)


def kill_solver(stage: Stage) -> bool:
    """Kill the processes of a solver at work."""
    job = _target(stage)
    if job is None:
        return False
    marked = f"{job.id}.{job.attempt}"
    solvers = [pid for pid in stage.studio.solvers(stage.stack) if marked in _environment(pid)]
    for pid in solvers:
        _kill(pid, signal.SIGKILL)
    return bool(solvers)


def kill_broker(stage: Stage) -> bool:
    """Kill the broker; the stack starts it again."""
    return _kill(stage.stack.pid("broker"), signal.SIGKILL)


def empty_broker(stage: Stage) -> bool:
    """Forget every message."""
    path = str(stage.stack.settings.broker_socket)
    with redis.Redis(unix_socket_path=path) as client:
        return bool(client.flushall())


def pause_broker(stage: Stage) -> bool:
    """Freeze the broker while jobs are submitted: it takes connections and never answers."""
    pid = stage.stack.pid("broker")
    _kill(pid, signal.SIGSTOP)
    try:
        stage.submit(len(stage.good) + 2)
        time.sleep(PAUSE)
    finally:
        _kill(pid, signal.SIGCONT)
    return True


def freeze_worker(stage: Stage) -> bool:
    """Stop a worker until its job is somebody else's, then let it go on."""
    job = _target(stage)
    if job is None or job.lease_owner is None:
        return False
    if not _freeze(stage, job.lease_owner):
        return False
    try:
        lost = stage.until(lambda: not _is_held(stage, job), seconds=3 * LEASE)
        time.sleep(1)
    finally:
        _signal(job.lease_owner, signal.SIGCONT)
    return lost


def fill_disk(stage: Stage) -> bool:
    """Leave no room for results until a job was put off for it."""
    if stage.disk is None:
        stage.disk_not_here = True
        return False
    stage.submit(len(stage.good) + 2)
    before = _put_off(stage)
    stage.disk.fill()
    try:
        return stage.until(lambda: _put_off(stage) > before, seconds=15)
    finally:
        stage.disk.clear()


def two_sweepers(stage: Stage) -> bool:
    """Stop the sweeper until another has its office, then let it go on beside that one."""
    if not stage.nobody_is_on_the_last_try():
        return False
    stage.until(lambda: _lives(_sweeper(stage)), seconds=10)
    holder = _sweeper(stage)
    if holder is None or not _freeze(stage, holder):
        return False
    try:
        return stage.until(lambda: _sweeper(stage) != holder, seconds=10)
    finally:
        _signal(holder, signal.SIGCONT)


BLOWS: dict[str, Callable[[Stage], bool]] = {
    "kill-worker": kill_worker,
    "kill-solver": kill_solver,
    "kill-broker": kill_broker,
    "empty-broker": empty_broker,
    "pause-broker": pause_broker,
    "freeze-worker": freeze_worker,
    "fill-disk": fill_disk,
    "two-sweepers": two_sweepers,
}


def _freeze(stage: Stage, worker: str) -> bool:
    """Stop a worker, but not in the middle of a write: that would stop all who want to write."""
    for _ in range(20):
        if not _signal(worker, signal.SIGSTOP):
            return False
        if _can_be_written(stage.store.database):
            return True
        _signal(worker, signal.SIGCONT)
        time.sleep(stage.dice.uniform(0.05, 0.3))
    return False


def _can_be_written(database: Database) -> bool:
    """Whether nobody keeps others from writing for longer than a moment."""
    if not database.is_sqlite:
        with database.engine.connect() as server:
            free = select(Lease.office).with_for_update(skip_locked=True)
            count = select(func.count()).select_from(Lease)
            return len(server.execute(free).all()) == server.scalar(count)
    path = str(database.url.database)
    with closing(sqlite3.connect(path, timeout=1, isolation_level=None)) as connection:
        try:
            connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return False
        connection.execute("ROLLBACK")
        return True


def _target(stage: Stage) -> Job | None:
    """Return a good job at work that can afford to lose an attempt."""
    if not stage.nobody_is_on_the_last_try() or not stage.until(stage.running, seconds=10):
        return None
    return stage.dice.choice(stage.running() or [None])


def _is_held(stage: Stage, job: Job) -> bool:
    with stage.store.read() as session:
        now = session.get(Job, job.id)
        return now is not None and now.state in HELD and now.attempt == job.attempt


def _put_off(stage: Stage) -> int:
    with stage.store.read() as session:
        return len(session.scalars(select(Attempt).where(Attempt.outcome == "postponed")).all())


def _sweeper(stage: Stage) -> str | None:
    with stage.store.read() as session:
        return session.scalar(select(Lease.holder).where(Lease.office == "sweeper"))


def _lives(worker: str | None) -> bool:
    return worker is not None and _signal(worker, 0)


def _signal(worker: str, number: int) -> bool:
    return _kill(int(worker.rpartition(":")[2]), number)


def _kill(pid: int, number: int) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False  # an earlier blow has hit it
    return True


def _environment(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/environ", errors="replace") as file:
            return file.read()
    except OSError:
        return ""
