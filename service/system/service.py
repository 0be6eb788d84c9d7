"""Readiness of the parts that the service needs, and its living workers."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from datetime import timedelta

import redis
import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.queue.wakeups import connect
from service.settings import Settings
from service.store.database import Store, clock
from service.store.models import Lease, Worker
from service.system.schemas import Readiness, WorkerView

# Row of the table of leases that is written to see whether anything can be
OFFICE = "readiness"
HOST = socket.gethostname()[:100]
# Seconds for which an answer is good: everybody may ask
KEPT = 2.0

log = structlog.get_logger()


class ReadinessCache:
    """The last answer of `readiness`, asked for anew by one at a time; others are told the last."""

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._settings = settings
        self._asking = threading.Lock()
        self._asked = -KEPT
        self._last: Readiness | None = None

    def ask(self) -> Readiness:
        """Return whether the parts answer, as of `KEPT` seconds ago, or of longer if they hang."""
        if self._last is not None:
            fresh = time.monotonic() - self._asked < KEPT
            if fresh or not self._asking.acquire(blocking=False):
                return self._last
        else:
            self._asking.acquire()
        try:
            self._last = readiness(self._store, self._settings)
            self._asked = time.monotonic()
            return self._last
        finally:
            self._asking.release()


def readiness(store: Store, settings: Settings) -> Readiness:
    """Ask database, broker and files, and count the workers seen lately."""
    workers: Counter[str] | None = None
    try:
        with store.write() as session:  # a full disk can be read
            session.merge(Lease(office=OFFICE, holder=HOST, until=clock(session)))
        workers = Counter(worker.queue for worker in living_workers(store, settings))
    except SQLAlchemyError as error:
        log.warning("database.unreachable", error=str(error))
    checks = {
        "database": workers is not None,
        "broker": _broker_answers(settings.broker),
        "files": store.files.ready(),
    }
    return Readiness(
        ready=all(checks.values()),
        checks={name: "ok" if fine else "failed" for name, fine in checks.items()},
        workers=workers or {},
    )


def living_workers(store: Store, settings: Settings) -> list[WorkerView]:
    """Return the workers seen lately, by name."""
    age = timedelta(seconds=3 * settings.sweep)
    with store.read() as session:
        seen = select(Worker).where(Worker.seen_at > clock(session) - age).order_by(Worker.name)
        return [WorkerView.model_validate(worker) for worker in session.scalars(seen)]


def _broker_answers(url: str) -> bool:
    try:
        with connect(url) as client:
            return bool(client.ping())
    except (redis.RedisError, OSError):
        return False
