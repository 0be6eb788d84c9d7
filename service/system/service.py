"""Whether the parts that the service needs answer."""

from __future__ import annotations

import os
from datetime import timedelta

import redis
import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.settings import Settings
from service.store.database import clock
from service.store.models import Worker
from service.store.queue import connect
from service.store.store import Store
from service.system.schemas import Readiness, WorkerView

log = structlog.get_logger()


def readiness(store: Store, settings: Settings) -> Readiness:
    """Ask database, broker and files, and list the workers seen lately."""
    workers: list[WorkerView] | None = None
    try:
        workers = _workers(store, timedelta(seconds=3 * settings.sweep))
    except SQLAlchemyError as error:
        log.warning("database.unreachable", error=str(error))
    checks = {
        "database": workers is not None,
        "broker": _broker_answers(settings.broker),
        "files": os.access(settings.files, os.W_OK),
    }
    return Readiness(
        ready=all(checks.values()),
        checks={name: "ok" if fine else "failed" for name, fine in checks.items()},
        workers=workers or [],
    )


def _workers(store: Store, age: timedelta) -> list[WorkerView]:
    with store.read() as session:
        seen = select(Worker).where(Worker.seen_at > clock(session) - age).order_by(Worker.name)
        return [WorkerView.model_validate(worker) for worker in session.scalars(seen)]


def _broker_answers(url: str) -> bool:
    try:
        with connect(url) as client:
            return bool(client.ping())
    except (redis.RedisError, OSError):
        return False
