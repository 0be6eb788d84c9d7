"""A worker for live sessions misses another one that has died, much sooner than a sweeper does."""

from __future__ import annotations

import fcntl
import threading
import time
from collections.abc import Callable
from pathlib import Path

import structlog
from sqlalchemy import or_, select
from sqlalchemy.exc import SQLAlchemyError

from service.queue import table
from service.queue.states import HELD, State
from service.queue.table import has_run_out, is_due
from service.queue.wakeups import LIVE, wake
from service.store.database import Store, clock
from service.store.models import Job

log = structlog.get_logger()


class Presence:
    """A file that a worker locks as long as it lives: whoever gets the lock knows it has died.

    ``folder`` is this host's own, so that a worker elsewhere is never taken for a dead one.
    """

    def __init__(self, folder: Path, name: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._own = (folder / f"lives.{name}").open("w")  # open for as long as this process lives
        fcntl.flock(self._own, fcntl.LOCK_EX)

    def is_dead(self, name: str) -> bool:
        """Return whether a worker of this host has died."""
        try:
            with (self._folder / f"lives.{name}").open() as other:
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (FileNotFoundError, BlockingIOError):
            return False
        return True

    def forget(self, name: str) -> None:
        """Remove the file of a worker that has died."""
        (self._folder / f"lives.{name}").unlink(missing_ok=True)


class Lookout(threading.Thread):
    """Wakes this worker for sessions that wait for one, and for those whose worker is lost.

    It looks every ``pause`` seconds while ``is_free`` says that the worker has a place. A worker
    of this host that has died has lost its sessions at once, another one when their lease is over.
    """

    def __init__(
        self,
        store: Store,
        presence: Presence,
        pause: float,
        is_free: Callable[[], bool],
        stopping: threading.Event,
    ) -> None:
        super().__init__(name="lookout", daemon=True)
        self._store = store
        self._presence = presence
        self._pause = pause
        self._is_free = is_free
        self._stopping = stopping

    def run(self) -> None:
        """Look until the worker stops."""
        while not self._stopping.wait(self._pause):
            try:
                if self._is_free():
                    self._look()
            except (SQLAlchemyError, OSError) as error:
                log.warning("lookout.failed", error=str(error))

    def _look(self) -> None:
        waiting, owners = self._find()
        dead = {name for name in set(owners.values()) if self._presence.is_dead(name)}
        if waiting is None and not dead:
            return
        began = time.monotonic()
        with self._store.write() as session:
            for job_id, name in owners.items():
                if name in dead:
                    table.expire(session, job_id, Job.lease_owner == name)
                    wake(session, job_id, LIVE)
            # one that has waited is not alone: the session's own worker may be alive
            if waiting is not None and time.monotonic() - began < self._pause:
                wake(session, waiting, LIVE)
        for name in dead:
            self._presence.forget(name)

    def _find(self) -> tuple[str | None, dict[str, str]]:
        """Return a session that waits for a worker, and whose those are that have one."""
        with self._store.read() as session:
            moment = clock(session)
            lost = Job.state.in_(HELD) & has_run_out(moment)
            waits = (Job.state == State.QUEUED) & is_due(Job, moment)
            query = select(Job.id).where(Job.queue == LIVE, or_(lost, waits)).limit(1)
            held = select(Job.id, Job.lease_owner).where(
                Job.queue == LIVE, Job.state.in_(HELD), Job.lease_owner.is_not(None)
            )
            owners = {job_id: str(name) for job_id, name in session.execute(held)}
            return session.scalar(query), owners
