"""Readiness of the parts that the service needs, and its living workers."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping
from datetime import timedelta

import redis
import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.queue.sweep import SWEEPER
from service.queue.wakeups import connect
from service.settings import Settings
from service.store.database import Store, clock
from service.store.models import Lease, Worker
from service.system.schemas import Readiness, SweeperState, WorkerView

# Row of the table of leases that is written to see whether anything can be
OFFICE = "readiness"
HOST = socket.gethostname()[:100]
# Seconds for which an answer is good: everybody may ask
KEPT = 2.0
PARTS = ("database", "broker", "files")
# After it a sweeper's term, which is three of its rounds, has been over for long
SILENT = timedelta(minutes=1)

log = structlog.get_logger()


class ReadinessCache:
    """The last answer of `readiness`, asked for anew by one at a time; others are told the last.

    Nobody waits for another: before the first answer it is "not ready", also while a part hangs.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._settings = settings
        self._asking = threading.Lock()
        self._asked = -KEPT
        self._last = _answer(dict.fromkeys(PARTS, False), {}, "unknown")

    def ask(self) -> Readiness:
        """Return whether the parts answer, as of `KEPT` seconds ago, or of longer if they hang."""
        if time.monotonic() - self._asked < KEPT or not self._asking.acquire(blocking=False):
            return self._last
        try:
            self._last = readiness(self._store, self._settings)
            self._asked = time.monotonic()
            return self._last
        finally:
            self._asking.release()


def readiness(store: Store, settings: Settings) -> Readiness:
    """Ask database, broker and files, count the workers seen lately, and look for the sweeper."""
    workers: Counter[str] | None = None
    sweeper: SweeperState = "unknown"
    try:
        with store.write() as session:  # a full disk can be read
            moment = clock(session)
            session.merge(Lease(office=OFFICE, holder=HOST, until=moment))
            until = session.scalar(select(Lease.until).where(Lease.office == SWEEPER))
        sweeper = "ok" if until is not None and until > moment - SILENT else "silent"
        workers = Counter(worker.queue for worker in living_workers(store, settings))
    except SQLAlchemyError as error:
        log.warning("database.unreachable", error=str(error))
    checks = {
        "database": workers is not None,
        "broker": _broker_answers(settings.broker),
        "files": store.files.ready(),
    }
    return _answer(checks, workers or {}, sweeper)


def _answer(
    checks: Mapping[str, bool], workers: Mapping[str, int], sweeper: SweeperState
) -> Readiness:
    return Readiness(
        ready=all(checks.values()),
        checks={name: "ok" if fine else "failed" for name, fine in checks.items()},
        workers=dict(workers),
        sweeper=sweeper,
    )


def living_workers(store: Store, settings: Settings) -> list[WorkerView]:
    """Return the workers seen lately, by name."""
    age = timedelta(seconds=settings.sweeper_term)
    with store.read() as session:
        seen = select(Worker).where(Worker.seen_at > clock(session) - age).order_by(Worker.name)
        return [WorkerView.model_validate(worker) for worker in session.scalars(seen)]


def _broker_answers(url: str) -> bool:
    try:
        with connect(url) as client:
            return bool(client.ping())
    except (redis.RedisError, OSError):
        return False
