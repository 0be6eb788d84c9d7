"""A worker for live sessions misses another one that has died, much sooner than a sweeper does."""

from __future__ import annotations

import fcntl
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.queue import table
from service.queue.states import HELD, State
from service.queue.table import is_due
from service.queue.wakeups import LIVE, wake
from service.store.database import Store, clock
from service.store.models import Job

# Looks in the time of a silence that is too long
LOOKS = 6

log = structlog.get_logger()


class Presence:
    """A file that a worker locks as long as it lives: whoever gets the lock knows it has died.

    ``folder`` is this host's own, so that a worker elsewhere is never taken for a dead one.
    """

    def __init__(self, folder: Path, name: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self.name = name
        self._own = (folder / f"lives.{name}").open("w")  # open for as long as this process lives
        fcntl.flock(self._own, fcntl.LOCK_EX)

    def is_alive(self, name: str) -> bool | None:
        """Return whether a worker of this host lives; None: it is none of this host's."""
        try:
            with (self._folder / f"lives.{name}").open() as other:
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return None
        except BlockingIOError:
            return True
        return False

    def forget(self, name: str) -> None:
        """Remove the file of a worker that has died."""
        (self._folder / f"lives.{name}").unlink(missing_ok=True)


class _Held(NamedTuple):
    """A session that a worker has, and when that said so last."""

    job_id: str
    worker: str
    leased_at: datetime


class Lookout(threading.Thread):
    """Wakes this worker for sessions that wait for one, and for those whose worker is lost.

    It looks while ``is_free`` says that this worker has a place. A worker of this host has lost its
    sessions at once when it has died, and only then; one elsewhere when it has said nothing for
    ``silence`` seconds.
    """

    def __init__(
        self,
        store: Store,
        presence: Presence,
        silence: float,
        is_free: Callable[[], bool],
        stopping: threading.Event,
    ) -> None:
        super().__init__(name="lookout", daemon=True)
        self._store = store
        self._presence = presence
        self._silence = silence
        self._pause = silence / LOOKS
        self._is_free = is_free
        self._stopping = stopping
        self._began: datetime | None = None  # by the database's clock

    def run(self) -> None:
        """Look until the worker stops."""
        while not self._stopping.wait(self._pause):
            try:
                if self._is_free():
                    self._look()
            except (SQLAlchemyError, OSError) as error:
                log.warning("lookout.failed", error=str(error))

    def _was_before(self, held: _Held) -> bool:
        """Return whether a worker held it that had this one's name before: in a container."""
        is_own = held.worker == self._presence.name
        return is_own and self._began is not None and held.leased_at < self._began

    def _look(self) -> None:
        waiting, held, moment = self._find()
        self._began = self._began or moment
        lives = {name: self._presence.is_alive(name) for name in {each.worker for each in held}}
        dead = [each for each in held if lives[each.worker] is False or self._was_before(each)]
        oldest = moment - timedelta(seconds=self._silence)
        silent = [each for each in held if lives[each.worker] is None and each.leased_at < oldest]
        if waiting is None and not dead and not silent:
            return
        began = time.monotonic()
        with self._store.write() as session:
            if time.monotonic() - began > self._pause:
                silent = []  # they may have waited for the database as well
            for job_id, worker, leased_at in [*dead, *silent]:
                same = (Job.lease_owner == worker) & (Job.leased_at == leased_at)
                table.expire(session, job_id, same)
                wake(session, job_id, LIVE)
            if waiting is not None:
                wake(session, waiting, LIVE)
        for each in dead:
            self._presence.forget(each.worker)

    def _find(self) -> tuple[str | None, list[_Held], datetime]:
        """Return a session that waits for a worker, those that have one, and the time."""
        with self._store.read() as session:
            moment = clock(session)
            due = (Job.queue == LIVE, Job.state == State.QUEUED, is_due(Job, moment))
            waiting = session.scalar(select(Job.id).where(*due).limit(1))
            held = select(Job.id, Job.lease_owner, Job.leased_at).where(
                Job.queue == LIVE, Job.state.in_(HELD)
            )
            found = [
                _Held(job_id, worker, leased_at)
                for job_id, worker, leased_at in session.execute(held)
                if worker is not None and leased_at is not None  # as of all that are held
            ]
        return waiting, found, moment
