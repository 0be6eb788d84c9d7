"""Readiness of the parts that the service needs, and its living workers."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta

import redis
import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.queue.wakeups import connect
from service.settings import Settings
from service.store.database import Store, clock
from service.store.models import Worker
from service.system.schemas import Readiness, WorkerView

log = structlog.get_logger()


def readiness(store: Store, settings: Settings) -> Readiness:
    """Ask database, broker and files, and count the workers seen lately."""
    workers: Counter[str] | None = None
    try:
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
