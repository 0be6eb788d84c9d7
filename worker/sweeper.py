"""The sweeper: one elected worker repairs what was lost; every worker shows that it lives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import structlog
from sqlalchemy import delete
from sqlalchemy.orm import Session

from service.queue import sweep
from service.queue.claims import Abilities
from service.settings import Settings
from service.store import deletion, retention
from service.store.database import Store
from service.store.models import Worker
from worker.abilities import lacking, show_life
from worker.caches import trim_all
from worker.orphans import remove_orphans

log = structlog.get_logger()


class Heartbeat(threading.Thread):
    """A thread that shows that a worker lives, every ``settings.sweep`` s until it stops.

    The worker does ``slots`` jobs of ``queue`` at a time, those that it can do.
    """

    def __init__(
        self,
        store: Store,
        settings: Settings,
        queue: str,
        can: Abilities,
        slots: int,
        stopping: threading.Event,
    ) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._store = store
        self._settings = settings
        self._queue = queue
        self._can = can
        self._slots = slots
        self._stopping = stopping

    def run(self) -> None:
        """Do a round now and then until the worker stops."""
        while True:
            try:
                self._round()
                self._show_pulse()
            except Exception as error:  # whatever it is, leases and receipts must go on
                log.warning("sweeper.failed", error=str(error), exc_info=True)
            if self._stopping.wait(self._settings.sweep):
                break
        with suppress(OSError):
            self._pulse.unlink()
        with self._store.write() as session:
            session.execute(delete(Worker).where(Worker.name == self._can.worker))

    def _round(self) -> None:
        with self._store.write() as session:
            self._show_life(session)

    def _show_pulse(self) -> None:
        """Touch a file whose age tells a container's health check that the rounds go on."""
        with suppress(OSError):
            self._pulse.parent.mkdir(parents=True, exist_ok=True)
            self._pulse.touch()

    @property
    def _pulse(self) -> Path:
        return self._settings.work / f"alive.{self._queue}"

    def _show_life(self, session: Session) -> None:
        show_life(session, self._queue, self._can, self._slots, lacking(self._settings))


class Sweeper(Heartbeat):
    """Repairs as well, if it is the one elected; its host has the files, and the broker's address.

    The first round sends everything queued again. What may take long, as the removal of many files,
    is a thread of its own: leases of lost workers are taken back meanwhile.
    """

    _at_once = True
    _collected = 0.0
    _cleaning: threading.Thread | None = None

    def _round(self) -> None:
        settings = self._settings
        with self._store.write() as session:
            self._show_life(session)
            holder = self._can.worker
            seconds = settings.sweeper_term
            elected = sweep.hold_office(session, sweep.SWEEPER, holder, seconds)
            if elected:
                sweep.expire_leases(session)
                sweep.remove_expired_uploads(session)
                sweep.forget_workers(session)
            if elected or self._at_once:
                sweep.resend(session, settings.resend_after, at_once=self._at_once)
        self._at_once = False
        if self._cleaning is None or not self._cleaning.is_alive():
            clean = partial(self._clean, elected)
            self._cleaning = threading.Thread(target=clean, name="cleaning", daemon=True)
            self._cleaning.start()

    def _clean(self, elected: bool) -> None:
        """Remove what nobody needs: of this host and, if ``elected``, of the service."""
        settings = self._settings
        steps: list[Callable[[], object]] = [
            partial(remove_orphans, self._store, settings.work),
            partial(trim_all, settings),
        ]
        if elected:
            steps.append(partial(retention.enforce, self._store, settings))
        due = self._collected + min(deletion.COLLECT_EVERY, settings.garbage_age)
        if elected and time.monotonic() > due:
            self._collected = time.monotonic()
            steps += [
                self._store.database.forget_deleted,
                self._collect_garbage,
                partial(deletion.close_receipts, self._store, settings.garbage_age),
                partial(sweep.measure_sizes, self._store),
            ]
        for step in steps:
            try:
                step()
            except Exception as error:  # one that fails keeps the others from nothing
                log.warning("sweeper.failed", error=str(error), exc_info=True)

    def _collect_garbage(self) -> None:
        if removed := deletion.collect_garbage(self._store, self._settings.garbage_age):
            log.info("files.collected", count=removed)
