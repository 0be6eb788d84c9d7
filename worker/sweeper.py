"""The sweeper: one elected worker repairs what was lost; every worker shows that it lives."""

from __future__ import annotations

import threading
import time

import structlog
from sqlalchemy import delete
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.settings import Settings
from service.store import retention, sweep
from service.store.database import clock
from service.store.models import Worker
from service.store.store import Store
from worker.orphans import remove_orphans

OFFICE = "sweeper"
GARBAGE_EVERY = 60.0

log = structlog.get_logger()


class Sweeper(threading.Thread):
    """A thread of the worker process ``name`` that does a round every ``settings.sweep`` s."""

    def __init__(
        self, store: Store, settings: Settings, name: str, queue: str, stopping: threading.Event
    ) -> None:
        super().__init__(name="sweeper", daemon=True)
        self._store = store
        self._settings = settings
        self._worker = name
        self._queue = queue
        self._stopping = stopping
        self._collected = time.monotonic()

    def run(self) -> None:
        """Sweep until the worker stops. The first round sends everything queued again."""
        at_once = True
        while True:
            try:
                self._round(at_once)
                at_once = False
            except (SQLAlchemyError, OSError) as error:
                log.warning("sweeper.failed", error=str(error))
            if self._stopping.wait(self._settings.sweep):
                break
        with self._store.write() as session:
            session.execute(delete(Worker).where(Worker.name == self._worker))

    def _round(self, at_once: bool) -> None:
        settings = self._settings
        with self._store.write() as session:
            self._show_life(session)
            elected = sweep.hold_office(session, OFFICE, self._worker, 3 * settings.sweep)
            if elected:
                sweep.expire_leases(session)
                sweep.remove_expired_uploads(session, settings.uploads)
                sweep.forget_workers(session)
            if elected or at_once:
                sweep.resend(session, settings.resend_after, at_once=at_once)
        if elected:
            retention.enforce(self._store, settings)
        remove_orphans(self._store, settings.work)
        if elected and time.monotonic() - self._collected > min(
            GARBAGE_EVERY, settings.garbage_age
        ):
            self._collected = time.monotonic()
            if removed := sweep.collect_garbage(self._store, settings.garbage_age):
                log.info("files.collected", count=removed)

    def _show_life(self, session: Session) -> None:
        worker = session.get(Worker, self._worker)
        if worker is None:
            session.add(Worker(name=self._worker, queue=self._queue))
        else:
            worker.seen_at = clock(session)
