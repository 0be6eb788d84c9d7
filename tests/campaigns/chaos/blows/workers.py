"""Workers, solvers and the sweeper: killed, frozen, two at once."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from contextlib import closing

from sqlalchemy import func, select

from service.store.database import Database
from service.store.models import Job, Lease
from tests.campaigns.chaos.stage import SETTINGS, Stage

LEASE = SETTINGS["lease"]


def kill_worker(stage: Stage) -> bool:
    """Kill a worker, one that is at a job if there is one."""
    if not stage.nobody_is_on_the_last_try():
        return False
    stage.until(stage.running, seconds=5)
    busy = [job.lease_owner for job in stage.running() if job.lease_owner]
    return send_signal(stage.dice.choice(busy or stage.workers()), signal.SIGKILL)


def kill_solver(stage: Stage) -> bool:
    """Kill the processes of a solver at work."""
    job = stage.target()
    if job is None:
        return False
    marked = f"{job.id}.{job.attempt}"
    solvers = [pid for pid in stage.studio.solvers(stage.stack) if marked in _environment(pid)]
    for pid in solvers:
        kill(pid, signal.SIGKILL)
    return bool(solvers)


def kill_live(stage: Stage) -> bool:
    """Kill the worker that holds the station's session."""
    with stage.store.read() as session:
        job = session.get(Job, stage.station.session)
    if job is None or job.lease_owner is None or job.lost + 1 >= job.max_attempts:
        return False
    return send_signal(job.lease_owner, signal.SIGKILL)


def freeze_worker(stage: Stage) -> bool:
    """Stop a worker until its job is somebody else's, then let it go on."""
    job = stage.target()
    if job is None or job.lease_owner is None:
        return False
    if not _freeze(stage, job.lease_owner):
        return False
    try:
        lost = stage.until(lambda: not stage.is_held(job), seconds=3 * LEASE)
        time.sleep(1)
    finally:
        send_signal(job.lease_owner, signal.SIGCONT)
    return lost


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
        send_signal(holder, signal.SIGCONT)


def send_signal(worker: str, number: int) -> bool:
    """Send a worker a signal; False: it is not there any more."""
    return kill(int(worker.rpartition(":")[2]), number)


def kill(pid: int, number: int) -> bool:
    """Send a process a signal; False: it is not there any more."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False  # an earlier blow has hit it
    return True


def _freeze(stage: Stage, worker: str) -> bool:
    """Stop a worker, but not in the middle of a write: that would stop all who want to write."""
    for _ in range(20):
        if not send_signal(worker, signal.SIGSTOP):
            return False
        if _can_be_written(stage.store.database):
            return True
        send_signal(worker, signal.SIGCONT)
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


def _sweeper(stage: Stage) -> str | None:
    with stage.store.read() as session:
        return session.scalar(select(Lease.holder).where(Lease.office == "sweeper"))


def _lives(worker: str | None) -> bool:
    return worker is not None and send_signal(worker, 0)


def _environment(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/environ", errors="replace") as file:
            return file.read()
    except OSError:
        return ""
